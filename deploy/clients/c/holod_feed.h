/*
 * Hands pictures with depth to a running holod through shared memory.
 *
 * holod must listen (`holod run --scene feed`). A program opens a feed once, and then for each
 * picture begins it, writes colour and depth where it is told to, and sends it:
 *
 *     struct holod_feed_format format = {
 *         .width_px = 640, .height_px = 480,
 *         .colour = HOLOD_RGBA8_SRGB, .depth = HOLOD_DEPTH_U16_MM,
 *         .name = "my renderer",
 *     };
 *     struct holod_feed *feed;
 *     struct holod_feed_slot slot;
 *     if (holod_feed_open(NULL, &format, &feed) == HOLOD_FEED_OK) {
 *         while (running && holod_feed_begin(feed, 1000, &slot) == HOLOD_FEED_OK) {
 *             render_into(slot.colour, slot.depth);
 *             if (holod_feed_send(feed, 0) != HOLOD_FEED_OK) break;
 *         }
 *     }
 *     if (*holod_feed_error(feed)) fprintf(stderr, "%s\n", holod_feed_error(feed));
 *     holod_feed_close(feed);
 *
 * Linux, C11, or C++. Nothing here raises a signal, writes to a terminal or starts a thread. One
 * feed must not be used by two threads at the same time; several feeds may be.
 */
#ifndef HOLOD_FEED_H
#define HOLOD_FEED_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum holod_feed_result {
    HOLOD_FEED_OK = 0,
    /* Not in time. The feed is as good as before. */
    HOLOD_FEED_TIMEOUT = 1,
    /* holod_feed_error() says why. */
    HOLOD_FEED_FAILED = 2
};

/* Rows begin at the top and have no padding. White is 1 (255 in 8 bits). */
enum holod_colour {
    HOLOD_RGBA8_SRGB = 1,          /* 8 bits each, sRGB; A is ignored */
    HOLOD_RGBA16F_LINEAR = 2,      /* half floats, linear light; A is ignored */
    HOLOD_RGB32F_PLANES_LINEAR = 3 /* all of R, then G, then B: floats, linear light */
};

/* Measured from the eye along the axis of view (z), not along the ray. */
enum holod_depth {
    HOLOD_DEPTH_NONE = 0,    /* the picture is a plane at plane_dpt */
    HOLOD_DEPTH_U16_MM = 1,  /* millimetres; 0 is no depth */
    HOLOD_DEPTH_F16_M = 2,   /* metres, half floats; NaN, 0 and negative are no depth */
    HOLOD_DEPTH_F16_DPT = 3, /* dioptres, half floats; NaN, infinite and negative are no depth */
    HOLOD_DEPTH_F32_M = 4,   /* metres, floats; NaN, 0 and negative are no depth */
    HOLOD_DEPTH_F32_DPT = 5  /* dioptres, floats; NaN, infinite and negative are no depth */
};

struct holod_feed_format {
    uint32_t width_px;
    uint32_t height_px;
    enum holod_colour colour;
    enum holod_depth depth;
    float plane_dpt;  /* with HOLOD_DEPTH_NONE: the distance, in dioptres; else 0 */
    const char *name; /* UTF-8, for holod's log and status; what exceeds 32 bytes is cut off */
    /* 1: pictures may say how they were taken, with holod_feed_set_view; a holod that knows version
     * 1 of the feed alone refuses that. 0: they say nothing, and any holod will do. */
    int tells_view;
};

/* How a picture was taken. holod records it and shows it to people. */
struct holod_feed_view {
    float focus_dpt;    /* where the camera was focused, 0 to 20 dioptres; below 0: not known */
    float across_deg;   /* the camera's field of view, 2 * atan(width_px / (2 * fx)); 0: not known */
    float up_deg;       /* the same with height_px and fy */
};

/* Where to write one picture. Both begin at a multiple of 64 bytes. */
struct holod_feed_slot {
    void *colour;
    size_t colour_bytes;
    void *depth; /* NULL with HOLOD_DEPTH_NONE */
    size_t depth_bytes;
};

enum holod_feed_outcome {
    HOLOD_FEED_TAKEN = 0,
    HOLOD_FEED_OVERTAKEN = 1, /* a newer picture came before holod needed this one */
    HOLOD_FEED_REFUSED = 2,   /* the last good picture stays on the panel */
    HOLOD_FEED_NOT_SHOWN = 3  /* another client or a scene is shown */
};

struct holod_feed_outcomes {
    uint64_t sent;
    uint64_t taken;
    uint64_t overtaken;
    uint64_t refused;
    uint64_t not_shown;
    uint64_t last_sequence;       /* of the picture heard of last; 0 where none was */
    enum holod_feed_outcome last; /* what became of it */
    const char *refusal;          /* why a picture was refused last; "" where none was */
};

struct holod_feed;

/*
 * Connects to holod. `path` is the socket. NULL is the first `feed` on which a holod listens, in
 * $RUNTIME_DIRECTORY, $XDG_RUNTIME_DIR/holod (/run/user/UID/holod without that variable),
 * $TMPDIR/holod-UID (/tmp/holod-UID), where this user owns that folder, and the service's
 * /run/holod. Waits for holod up to 5 s.
 *
 * Also after a failure *feed can tell its error and must be closed.
 */
enum holod_feed_result holod_feed_open(const char *path, const struct holod_feed_format *format,
                                       struct holod_feed **feed);

/*
 * Gives a slot to write the next picture into; it may still hold an old one. Where all slots are
 * with holod it waits for one up to `timeout_ms`; 0 does not wait, and below 0 there is no limit.
 * A picture that was begun and not sent is begun again, in the same slot.
 */
enum holod_feed_result holod_feed_begin(struct holod_feed *feed, int timeout_ms,
                                        struct holod_feed_slot *slot);

/*
 * Says how the pictures that are sent from now on were taken. NULL: that is not known. Fails where
 * a figure cannot be, or the feed was opened without tells_view; what was said before stays then.
 */
enum holod_feed_result holod_feed_set_view(struct holod_feed *feed,
                                           const struct holod_feed_view *view);

/*
 * Hands over the picture that was begun; its slot must not be touched any more. `t_capture_ns` is
 * when it was taken, in nanoseconds of CLOCK_MONOTONIC, or 0 where that is not known.
 */
enum holod_feed_result holod_feed_send(struct holod_feed *feed, int64_t t_capture_ns);

/*
 * Tells holod, with the next picture, that `pictures` were left out before it: a program that does
 * not wait says so of what it could not send.
 */
void holod_feed_leave_out(struct holod_feed *feed, uint64_t pictures);

/*
 * Waits until it is known of every picture sent what became of it, up to `timeout_ms` (as in
 * holod_feed_begin). For the last picture before closing, and with 0 to look without waiting.
 */
enum holod_feed_result holod_feed_wait(struct holod_feed *feed, int timeout_ms);

/* What became of the pictures, as far as the last call heard. Valid until holod_feed_close. */
const struct holod_feed_outcomes *holod_feed_outcomes(const struct holod_feed *feed);

/* What went wrong last, in UTF-8, and what to do; "" where nothing did. */
const char *holod_feed_error(const struct holod_feed *feed);

/* The last picture stays on the panel. NULL is allowed. */
void holod_feed_close(struct holod_feed *feed);

#ifdef __cplusplus
}
#endif

#endif
