/*
 * Does with a feed what the lines on standard input say, and prints how each went.
 *
 *     driver SOCKET WIDTHxHEIGHT COLOUR DEPTH PLANE_DPT NAME [tells_view]
 */
#define _POSIX_C_SOURCE 200809L

#include "holod_feed.h"

#include <inttypes.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void ignore(int number)
{
    (void)number;
}

static void fill(unsigned char *bytes, size_t count, unsigned seed)
{
    for (size_t k = 0; k < count; k++)
        bytes[k] = (unsigned char)(seed + k * 7 + k / 251);
}

static void print_result(const struct holod_feed *feed, enum holod_feed_result result)
{
    static const char *const names[] = {"ok", "timeout", "failed"};
    printf("%s%s%s\n", names[result], result ? ": " : "", result ? holod_feed_error(feed) : "");
}

int main(int argc, char **argv)
{
    struct holod_feed_format format = {0};
    if (argc < 7 || argc > 8 ||
        sscanf(argv[2], "%" SCNu32 "x%" SCNu32, &format.width_px, &format.height_px) != 2)
        return 64;
    format.colour = (enum holod_colour)atoi(argv[3]);
    format.depth = (enum holod_depth)atoi(argv[4]);
    format.plane_dpt = (float)atof(argv[5]);
    format.name = argv[6];
    format.tells_view = argc == 8;

    /* Without SA_RESTART: every call that waits is interrupted. */
    struct sigaction action = {.sa_handler = ignore};
    sigaction(SIGUSR1, &action, NULL);
    setvbuf(stdout, NULL, _IOLBF, 0);

    struct holod_feed *feed;
    struct holod_feed_slot slot = {0};
    enum holod_feed_result opened = holod_feed_open(*argv[1] ? argv[1] : NULL, &format, &feed);
    print_result(feed, opened);
    char line[64], word[64];
    while (fgets(line, sizeof line, stdin)) {
        long long number = 0;
        if (sscanf(line, "%63s %lld", word, &number) < 1)
            return 65;
        if (strcmp(word, "begin") == 0) {
            print_result(feed, holod_feed_begin(feed, (int)number, &slot));
        } else if (strcmp(word, "fill") == 0) {
            fill(slot.colour, slot.colour_bytes, (unsigned)number);
            fill(slot.depth, slot.depth_bytes, (unsigned)number + 128);
            puts("ok");
        } else if (strcmp(word, "send") == 0) {
            print_result(feed, holod_feed_send(feed, number));
        } else if (strcmp(word, "view") == 0) {
            struct holod_feed_view view = {0};
            bool is_known = sscanf(line, "view %f %f %f", &view.focus_dpt, &view.across_deg, &view.up_deg) == 3;
            print_result(feed, holod_feed_set_view(feed, is_known ? &view : NULL));
        } else if (strcmp(word, "leave_out") == 0) {
            holod_feed_leave_out(feed, (uint64_t)number);
            puts("ok");
        } else if (strcmp(word, "wait") == 0) {
            print_result(feed, holod_feed_wait(feed, (int)number));
        } else if (strcmp(word, "error") == 0) {
            puts(holod_feed_error(feed));
        } else if (strcmp(word, "outcomes") == 0) {
            const struct holod_feed_outcomes *seen = holod_feed_outcomes(feed);
            printf("%" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64 " %" PRIu64
                   " %d %s\n",
                   seen->sent, seen->taken, seen->overtaken, seen->refused, seen->not_shown,
                   seen->last_sequence, (int)seen->last, seen->refusal);
        } else {
            return 65;
        }
    }
    holod_feed_close(feed);
    return 0;
}
