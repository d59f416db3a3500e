/*
 * Feeds holod a moving picture: a near card that swings in front of a far one.
 *
 *     cc -std=c11 -O2 -o example example.c holod_feed.c
 *     ./example [SOCKET] [WIDTHxHEIGHT] [SECONDS] [FRAMES_PER_SECOND]
 *
 * `-` as SOCKET, or none, is where holod listens by itself.
 */
#define _POSIX_C_SOURCE 200809L

#include "holod_feed.h"

#include <errno.h>
#include <inttypes.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sysexits.h>
#include <time.h>

#define WAIT_MS 5000

enum { BACKGROUND_MM = 4000, FAR_CARD_MM = 2000, NEAR_CARD_MM = 400 };

struct rectangle {
    uint32_t left, top, width, height;
};

static bool contains(const struct rectangle *rectangle, uint32_t x, uint32_t y)
{
    return x >= rectangle->left && x - rectangle->left < rectangle->width && y >= rectangle->top &&
           y - rectangle->top < rectangle->height;
}

/* Stripes of 8 pixels on both cards: an eye needs edges to tell what is in focus. */
static void draw(const struct holod_feed_slot *slot, uint32_t width, uint32_t height,
                 uint32_t frame)
{
    uint8_t *colour = slot->colour;
    uint16_t *depth_mm = slot->depth;
    uint32_t travel = width - width / 4;
    uint32_t swing = frame * 4 % (2 * travel);
    struct rectangle far_card = {width / 8, height / 8, width / 2, height / 2};
    struct rectangle near_card = {swing < travel ? swing : 2 * travel - swing, height / 2,
                                  width / 4, height / 3};

    for (uint32_t y = 0; y < height; y++) {
        for (uint32_t x = 0; x < width; x++) {
            uint8_t rgb[3] = {40, 40, (uint8_t)(y * 128 / height)};
            uint16_t mm = BACKGROUND_MM;
            if (contains(&near_card, x, y)) {
                uint8_t stripe = (x - near_card.left) / 8 % 2 ? 240 : 30;
                memcpy(rgb, (uint8_t[]){stripe, stripe, 30}, 3);
                mm = NEAR_CARD_MM;
            } else if (contains(&far_card, x, y)) {
                uint8_t stripe = (y - far_card.top) / 8 % 2 ? 220 : 60;
                memcpy(rgb, (uint8_t[]){60, stripe, stripe}, 3);
                mm = FAR_CARD_MM;
            }
            memcpy(colour, rgb, 3);
            colour[3] = 255;
            *depth_mm = mm;
            colour += 4;
            depth_mm++;
        }
    }
}

static int64_t nanoseconds(struct timespec time)
{
    return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static void sleep_until(int64_t time_ns)
{
    struct timespec until = {.tv_sec = (time_t)(time_ns / 1000000000),
                             .tv_nsec = time_ns % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR)
        ;
}

/* Sends `frames` pictures at their times; those for which holod has no slot free are left out. */
static bool play(struct holod_feed *feed, uint32_t width, uint32_t height, uint32_t frames,
                 double frames_per_s)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    int64_t start_ns = nanoseconds(now);
    for (uint32_t frame = 0; frame < frames; frame++) {
        int64_t due_ns = start_ns + (int64_t)(frame / frames_per_s * 1e9);
        sleep_until(due_ns);
        struct holod_feed_slot slot;
        enum holod_feed_result result = holod_feed_begin(feed, 0, &slot);
        if (result == HOLOD_FEED_TIMEOUT) {
            holod_feed_leave_out(feed, 1);
            continue;
        }
        if (result != HOLOD_FEED_OK)
            return false;
        draw(&slot, width, height, frame);
        if (holod_feed_send(feed, due_ns) != HOLOD_FEED_OK)
            return false;
    }
    return holod_feed_wait(feed, WAIT_MS) == HOLOD_FEED_OK;
}

int main(int argc, char **argv)
{
    const char *path = argc > 1 && strcmp(argv[1], "-") != 0 ? argv[1] : NULL;
    uint32_t width = 640, height = 480;
    double seconds = 10, frames_per_s = 30;
    char rest;
    if (argc > 5 ||
        (argc > 2 && sscanf(argv[2], "%" SCNu32 "x%" SCNu32 "%c", &width, &height, &rest) != 2) ||
        (argc > 3 && sscanf(argv[3], "%lf%c", &seconds, &rest) != 1) ||
        (argc > 4 && sscanf(argv[4], "%lf%c", &frames_per_s, &rest) != 1) || width < 4 ||
        !(seconds >= 0 && seconds <= 1e6) || !(frames_per_s > 0 && frames_per_s <= 1000)) {
        fprintf(stderr, "usage: %s [SOCKET|-] [WIDTHxHEIGHT] [SECONDS] [FRAMES_PER_SECOND]\n",
                argv[0]);
        return EX_USAGE;
    }

    struct holod_feed_format format = {
        .width_px = width,
        .height_px = height,
        .colour = HOLOD_RGBA8_SRGB,
        .depth = HOLOD_DEPTH_U16_MM,
        .name = "two cards (C example)",
    };
    struct holod_feed *feed;
    bool open = holod_feed_open(path, &format, &feed) == HOLOD_FEED_OK;
    bool ok = open && play(feed, width, height, (uint32_t)(seconds * frames_per_s), frames_per_s);
    if (!ok)
        fprintf(stderr, "error: %s\n", holod_feed_error(feed));
    if (open) {
        const struct holod_feed_outcomes *outcomes = holod_feed_outcomes(feed);
        printf("%" PRIu64 " sent: %" PRIu64 " taken, %" PRIu64 " overtaken, %" PRIu64
               " refused, %" PRIu64 " while another client was shown\n",
               outcomes->sent, outcomes->taken, outcomes->overtaken, outcomes->refused,
               outcomes->not_shown);
        if (*outcomes->refusal)
            printf("refused because: %s\n", outcomes->refusal);
    }
    holod_feed_close(feed);
    return ok ? 0 : EX_UNAVAILABLE;
}
