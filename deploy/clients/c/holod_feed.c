#define _POSIX_C_SOURCE 200809L

#include "holod_feed.h"

#include <errno.h>
#include <inttypes.h>
#include <limits.h>
#include <poll.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define PROTOCOL_VERSION 2
#define NEAREST_DPT 20
#define ANSWER_TIMEOUT_S 5
#define MOST_SLOTS 64
#define ALIGNMENT 64
#define TEXT_BYTES 1024
#ifndef SERVICE_PATH
#define SERVICE_PATH "/run/holod/feed"
#endif

/* The messages of daemon/doc/feed.md. */

struct helo {
    char kind[4];
    uint32_t version;
    uint32_t width_px;
    uint32_t height_px;
    uint32_t colour;
    uint32_t depth;
    float plane_dpt;
    uint32_t reserved;
    char name[32];
};
_Static_assert(sizeof(struct helo) == 64, "HELO has 64 bytes");

struct ring {
    char kind[4];
    uint32_t slots;
    uint64_t distance;
    uint64_t colour_offset;
    uint64_t colour_bytes;
    uint64_t depth_offset;
    uint64_t depth_bytes;
};
_Static_assert(sizeof(struct ring) == 48, "RING has 48 bytes");

struct fram {
    char kind[4];
    uint32_t slot;
    uint64_t sequence;
    int64_t t_capture_ns;
    uint32_t given; /* of HAS_ */
    float focus_dpt;
    float across_deg;
    float up_deg;
};
#define HAS_FOCUS 1
#define HAS_FIELD_OF_VIEW 2
_Static_assert(sizeof(struct fram) == 40, "FRAM has 40 bytes");

struct freed {
    char kind[4];
    uint32_t slot;
    uint64_t sequence;
    uint32_t outcome;
    uint32_t reserved;
};
_Static_assert(sizeof(struct freed) == 24, "FREE has 24 bytes before its text");

#define NOPE_BYTES 4

struct message {
    size_t length;
    char bytes[sizeof(struct freed) + TEXT_BYTES];
};

typedef char socket_path[sizeof(((struct sockaddr_un *)0)->sun_path)];

struct holod_feed {
    int socket; /* -1 before it is open and once it has failed */
    socket_path path;
    struct ring ring;
    unsigned char *memory;
    size_t memory_bytes;
    uint64_t free_slots; /* bit k: slot k belongs to this program */
    int begun;           /* the slot being written, or -1 */
    uint64_t sequence;   /* of the newest picture, sent or left out */
    bool tells_view;
    struct holod_feed_view view; /* how the pictures were taken */
    struct holod_feed_outcomes outcomes;
    char refusal[TEXT_BYTES];
    char error[TEXT_BYTES];
};

/* Errors */

__attribute__((format(printf, 3, 4))) static enum holod_feed_result
report(struct holod_feed *feed, enum holod_feed_result result, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(feed->error, sizeof feed->error, format, arguments);
    va_end(arguments);
    return result;
}

/* The feed cannot go on. Its memory stays mapped: the program may be writing into it. */
__attribute__((format(printf, 2, 3))) static enum holod_feed_result fail(struct holod_feed *feed,
                                                                         const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(feed->error, sizeof feed->error, format, arguments);
    va_end(arguments);
    if (feed->socket >= 0)
        close(feed->socket);
    feed->socket = -1;
    return HOLOD_FEED_FAILED;
}

/* Time */

#define NO_DEADLINE INT64_MAX

static int64_t now_ms(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000 + now.tv_nsec / 1000000;
}

static int64_t deadline_ms(int timeout_ms)
{
    return timeout_ms < 0 ? NO_DEADLINE : now_ms() + timeout_ms;
}

/* True where the socket has something to say, false at the deadline. */
static bool wait_readable(int socket, int64_t deadline)
{
    for (;;) {
        int timeout_ms = -1;
        if (deadline != NO_DEADLINE) {
            int64_t left_ms = deadline - now_ms();
            if (left_ms <= 0)
                return false;
            timeout_ms = left_ms < INT_MAX ? (int)left_ms : INT_MAX;
        }
        struct pollfd waited = {.fd = socket, .events = POLLIN};
        if (poll(&waited, 1, timeout_ms) > 0)
            return true;
    }
}

/* Messages */

/*
 * One message, or HOLOD_FEED_TIMEOUT where none came until the deadline. A descriptor that comes
 * with it goes to *descriptor, where that is not NULL.
 */
static enum holod_feed_result receive(struct holod_feed *feed, int64_t deadline,
                                      struct message *message, int *descriptor)
{
    bool was_reset = false;
    for (;;) {
        union {
            struct cmsghdr header;
            char bytes[CMSG_SPACE(sizeof(int))];
        } control;
        struct iovec bytes = {.iov_base = message->bytes, .iov_len = sizeof message->bytes};
        struct msghdr header = {.msg_iov = &bytes, .msg_iovlen = 1};
        if (descriptor) {
            header.msg_control = &control;
            /* Not CMSG_SPACE, in which there is room for a second one that nobody would close. */
            header.msg_controllen = CMSG_LEN(sizeof(int));
        }
        ssize_t length = recvmsg(feed->socket, &header, MSG_DONTWAIT | MSG_CMSG_CLOEXEC);
        if (length < 0 && errno == EINTR)
            continue;
        if (length < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) {
            if (!wait_readable(feed->socket, deadline))
                return HOLOD_FEED_TIMEOUT;
            continue;
        }
        /* Linux reports once that holod closed without reading everything, before what it wrote. */
        if (length < 0 && errno == ECONNRESET && !was_reset) {
            was_reset = true;
            continue;
        }
        if (length < 0 && errno != ECONNRESET)
            return fail(feed, "cannot read from %s: %s", feed->path, strerror(errno));
        if (length <= 0)
            return fail(feed,
                        "holod closed the connection on %s: it was stopped or has crashed; see its "
                        "log, start it and open the feed again",
                        feed->path);

        message->length = (size_t)length;
        struct cmsghdr *rights = descriptor ? CMSG_FIRSTHDR(&header) : NULL;
        if (rights && rights->cmsg_level == SOL_SOCKET && rights->cmsg_type == SCM_RIGHTS)
            memcpy(descriptor, CMSG_DATA(rights), sizeof(int));
        if (message->length >= NOPE_BYTES && memcmp(message->bytes, "NOPE", 4) == 0)
            return fail(feed, "holod refused the connection on %s: %.*s", feed->path,
                        (int)(message->length - NOPE_BYTES), message->bytes + NOPE_BYTES);
        return HOLOD_FEED_OK;
    }
}

/* A message that this program does not know: of what kind, and how long it is. */
static enum holod_feed_result unexpected(struct holod_feed *feed, const struct message *message,
                                         const char *expected)
{
    char kind[5] = "";
    for (size_t k = 0; k < 4 && k < message->length; k++)
        kind[k] = message->bytes[k] >= ' ' && message->bytes[k] <= '~' ? message->bytes[k] : '?';
    return fail(feed,
                "%s sent a message '%s' of %zu bytes, expected %s: is it holod, of a version that "
                "speaks version 1 or %d of the feed?",
                feed->path, kind, message->length, expected, PROTOCOL_VERSION);
}

static enum holod_feed_result send_message(struct holod_feed *feed, const void *bytes,
                                           size_t length)
{
    ssize_t sent;
    do
        sent = send(feed->socket, bytes, length, MSG_NOSIGNAL);
    while (sent < 0 && errno == EINTR);
    if (sent >= 0)
        return HOLOD_FEED_OK;
    if (errno == EAGAIN || errno == EWOULDBLOCK)
        return fail(feed, "holod read nothing from %s for %d s: see its log, start it again",
                    feed->path, ANSWER_TIMEOUT_S);
    if (errno != EPIPE && errno != ECONNRESET)
        return fail(feed, "cannot send to %s: %s", feed->path, strerror(errno));
    /* holod has closed, and may have said why. What it said before that is of no use any more. */
    struct message last;
    int64_t deadline = deadline_ms(ANSWER_TIMEOUT_S * 1000);
    enum holod_feed_result result;
    do
        result = receive(feed, deadline, &last, NULL);
    while (result == HOLOD_FEED_OK);
    if (result == HOLOD_FEED_TIMEOUT)
        return fail(feed, "holod reads no more from %s: see its log, start it again", feed->path);
    return result;
}

/* Takes back the slot that a FREE names. */
static enum holod_feed_result take_back(struct holod_feed *feed, const struct message *message)
{
    struct freed freed;
    if (message->length < sizeof freed || memcmp(message->bytes, "FREE", 4) != 0)
        return unexpected(feed, message, "FREE with at least 24 bytes");
    memcpy(&freed, message->bytes, sizeof freed);
    if (freed.slot >= feed->ring.slots || feed->free_slots >> freed.slot & 1 ||
        (int)freed.slot == feed->begun)
        return fail(feed, "holod gave back slot %" PRIu32 ", which it did not have: report this",
                    freed.slot);
    struct holod_feed_outcomes *outcomes = &feed->outcomes;
    switch (freed.outcome) {
    case HOLOD_FEED_TAKEN:
        outcomes->taken++;
        break;
    case HOLOD_FEED_OVERTAKEN:
        outcomes->overtaken++;
        break;
    case HOLOD_FEED_REFUSED:
        outcomes->refused++;
        snprintf(feed->refusal, sizeof feed->refusal, "%.*s", (int)(message->length - sizeof freed),
                 message->bytes + sizeof freed);
        break;
    case HOLOD_FEED_NOT_SHOWN:
        outcomes->not_shown++;
        break;
    default:
        return fail(feed, "holod said %" PRIu32 " of a picture, expected 0 to 3: is it newer?",
                    freed.outcome);
    }
    outcomes->last = (enum holod_feed_outcome)freed.outcome;
    outcomes->last_sequence = freed.sequence;
    feed->free_slots |= UINT64_C(1) << freed.slot;
    return HOLOD_FEED_OK;
}

static enum holod_feed_result receive_free(struct holod_feed *feed, int64_t deadline)
{
    struct message message;
    enum holod_feed_result result = receive(feed, deadline, &message, NULL);
    return result == HOLOD_FEED_OK ? take_back(feed, &message) : result;
}

static enum holod_feed_result receive_what_is_there(struct holod_feed *feed)
{
    enum holod_feed_result result;
    do
        result = receive_free(feed, deadline_ms(0));
    while (result == HOLOD_FEED_OK);
    return result == HOLOD_FEED_TIMEOUT ? HOLOD_FEED_OK : result;
}

/* Opening */

#define MOST_PATHS 4
#define NOBODY_LISTENS                                                                            \
    "no holod listens on %s: start it with `holod run --scene feed`, or give the path that its "  \
    "log names"

/* Leaves out what is too long for a socket: nobody listens there. */
__attribute__((format(printf, 3, 4))) static void add_path(socket_path paths[MOST_PATHS],
                                                           size_t *count, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    int length = vsnprintf(paths[*count], sizeof paths[*count], format, arguments);
    va_end(arguments);
    if (length >= 0 && (size_t)length < sizeof paths[*count])
        ++*count;
}

static const char *absolute(const char *variable)
{
    const char *value = getenv(variable);
    return value && *value == '/' ? value : NULL;
}

static bool is_folder(const char *path)
{
    struct stat found;
    return stat(path, &found) == 0 && S_ISDIR(found.st_mode);
}

/* The folder in which this user's holod has its sockets where it has no other; false where its name
 * is too long. Anybody could have made it first: it must be used only where it is_own. */
static bool temporary_folder(socket_path folder)
{
    const char *temporary = getenv("TMPDIR");
    if (!temporary)
        temporary = "/tmp";
    int length = snprintf(folder, sizeof(socket_path), "%s%sholod-%lu", temporary,
                          *temporary ? "/" : "", (unsigned long)getuid());
    return length >= 0 && (size_t)length < sizeof(socket_path);
}

/* Whether the folder is there, no link, and this user's. */
static bool is_own(const char *folder, bool *is_there)
{
    struct stat found;
    *is_there = lstat(folder, &found) == 0;
    return *is_there && S_ISDIR(found.st_mode) && found.st_uid == geteuid();
}

/* Where a holod may listen by itself, as daemon/src/runtime_folder.rs says, and then the service.
 * Returns how many they are. */
static size_t default_paths(socket_path paths[MOST_PATHS])
{
    const char *runtime = absolute("RUNTIME_DIRECTORY");
    const char *xdg_runtime = absolute("XDG_RUNTIME_DIR");
    char login[64];
    snprintf(login, sizeof login, "/run/user/%lu", (unsigned long)getuid());
    if (!xdg_runtime && is_folder(login))
        xdg_runtime = login;

    size_t count = 0;
    socket_path folder;
    if (runtime)
        add_path(paths, &count, "%s/feed", runtime);
    if (xdg_runtime)
        add_path(paths, &count, "%s/holod/feed", xdg_runtime);
    if (temporary_folder(folder))
        add_path(paths, &count, "%s/feed", folder);
    add_path(paths, &count, "%s", SERVICE_PATH);
    return count;
}

/* Where nobody listens there, also where a holod that was killed has left its socket, says so in
 * *is_nobody. */
static enum holod_feed_result connect_to(struct holod_feed *feed, const char *path,
                                         bool *is_nobody)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    int length = snprintf(feed->path, sizeof feed->path, "%s", path);
    if (length < 0 || (size_t)length >= sizeof feed->path)
        return fail(feed,
                    "the path %s... has %d bytes, and a socket's at most %zu: use a shorter one",
                    feed->path, length, sizeof feed->path - 1);
    memcpy(address.sun_path, feed->path, sizeof feed->path);

    feed->socket = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    if (feed->socket < 0)
        return fail(feed, "cannot make a socket: %s", strerror(errno));
    struct timeval patience = {.tv_sec = ANSWER_TIMEOUT_S};
    if (setsockopt(feed->socket, SOL_SOCKET, SO_SNDTIMEO, &patience, sizeof patience) != 0)
        return fail(feed, "cannot limit how long a socket waits: %s", strerror(errno));

    int connected;
    do
        connected = connect(feed->socket, (const struct sockaddr *)&address, sizeof address);
    while (connected != 0 && errno == EINTR);
    if (connected == 0)
        return HOLOD_FEED_OK;
    switch (errno) {
    case ENOENT:
    case ENOTDIR:
    case ECONNREFUSED:
        *is_nobody = true;
        return fail(feed, NOBODY_LISTENS, feed->path);
    case EACCES:
        return fail(feed,
                    "this user may not open %s: run as the user that holod runs as, or as one who "
                    "may write to that socket",
                    feed->path);
    case EPROTOTYPE:
        return fail(feed,
                    "%s is a socket of another type than holod's (SOCK_SEQPACKET): it belongs to "
                    "another program; give the path that holod's log names",
                    feed->path);
    case EAGAIN:
        return fail(feed, "holod has let nobody in on %s for %d s: see its log, start it again",
                    feed->path, ANSWER_TIMEOUT_S);
    default:
        return fail(feed, "cannot connect to %s: %s", feed->path, strerror(errno));
    }
}

/* The first of the paths of its own on which a holod listens. */
static enum holod_feed_result connect_to_any(struct holod_feed *feed)
{
    socket_path paths[MOST_PATHS], folder;
    char tried[MOST_PATHS * (sizeof paths[0] + sizeof " or ")] = "";
    bool has_folder = temporary_folder(folder), is_there = false, is_anothers = false;
    size_t count = default_paths(paths);
    for (size_t k = 0; k < count; k++) {
        bool is_in_it = has_folder && strncmp(paths[k], folder, strlen(folder)) == 0 &&
                        strcmp(paths[k] + strlen(folder), "/feed") == 0;
        if (is_in_it && !is_own(folder, &is_there)) {
            is_anothers = is_there;
        } else {
            bool is_nobody = false;
            enum holod_feed_result result = connect_to(feed, paths[k], &is_nobody);
            if (result == HOLOD_FEED_OK)
                feed->error[0] = '\0';
            if (!is_nobody)
                return result;
        }
        size_t length = strlen(tried);
        snprintf(tried + length, sizeof tried - length, "%s%s", k ? " or " : "", paths[k]);
    }
    if (is_anothers)
        return fail(feed,
                    NOBODY_LISTENS "; nothing in %s is used, which is no folder of this user's",
                    tried, folder);
    return fail(feed, NOBODY_LISTENS, tried);
}

static enum holod_feed_result say_hello(struct holod_feed *feed,
                                        const struct holod_feed_format *format)
{
    struct helo helo = {
        .kind = {'H', 'E', 'L', 'O'},
        .version = format->tells_view ? PROTOCOL_VERSION : 1,
        .width_px = format->width_px,
        .height_px = format->height_px,
        .colour = format->colour,
        .depth = format->depth,
        .plane_dpt = format->plane_dpt,
    };
    const char *name = format->name ? format->name : "";
    size_t length = strlen(name);
    if (length > sizeof helo.name) {
        length = sizeof helo.name;
        /* 10xxxxxx continues a character of UTF-8: none is cut in two. */
        while (length > 0 && ((unsigned char)name[length] & 0xC0) == 0x80)
            length--;
    }
    memcpy(helo.name, name, length);
    return send_message(feed, &helo, sizeof helo);
}

static uint64_t colour_pixel_bytes(enum holod_colour colour)
{
    switch (colour) {
    case HOLOD_RGBA8_SRGB:
        return 4;
    case HOLOD_RGBA16F_LINEAR:
        return 8;
    case HOLOD_RGB32F_PLANES_LINEAR:
        return 12;
    }
    return 0;
}

static uint64_t depth_pixel_bytes(enum holod_depth depth)
{
    switch (depth) {
    case HOLOD_DEPTH_NONE:
        return 0;
    case HOLOD_DEPTH_U16_MM:
    case HOLOD_DEPTH_F16_M:
    case HOLOD_DEPTH_F16_DPT:
        return 2;
    case HOLOD_DEPTH_F32_M:
    case HOLOD_DEPTH_F32_DPT:
        return 4;
    }
    return 0;
}

static bool inside(uint64_t offset, uint64_t bytes, uint64_t distance)
{
    return offset % ALIGNMENT == 0 && offset <= distance && bytes <= distance - offset;
}

/* Maps what holod sent, where it has room for the pictures of `format`. */
static enum holod_feed_result map_memory(struct holod_feed *feed,
                                         const struct holod_feed_format *format, int memory)
{
    const struct ring *ring = &feed->ring;
    uint64_t pixels = (uint64_t)format->width_px * format->height_px;
    uint64_t colour_bytes = pixels * colour_pixel_bytes(format->colour);
    uint64_t depth_bytes = pixels * depth_pixel_bytes(format->depth);
    if (ring->slots < 1 || ring->slots > MOST_SLOTS)
        return fail(feed, "holod offers %" PRIu32 " slots, expected 1 to %d", ring->slots,
                    MOST_SLOTS);
    if (ring->colour_bytes != colour_bytes || ring->depth_bytes != depth_bytes)
        return fail(feed,
                    "holod has room for %" PRIu64 " bytes of colour and %" PRIu64
                    " of depth, expected %" PRIu64 " and %" PRIu64 ": report this",
                    ring->colour_bytes, ring->depth_bytes, colour_bytes, depth_bytes);
    if (ring->distance % ALIGNMENT != 0 || ring->distance > SIZE_MAX / ring->slots ||
        !inside(ring->colour_offset, colour_bytes, ring->distance) ||
        !inside(ring->depth_offset, depth_bytes, ring->distance))
        return fail(feed,
                    "holod put colour at %" PRIu64 " and depth at %" PRIu64 " in slots of %" PRIu64
                    " bytes: not multiples of %d, or outside; report this",
                    ring->colour_offset, ring->depth_offset, ring->distance, ALIGNMENT);
    if (memory < 0)
        return fail(feed, "holod sent no memory, or this program has too many files open");

    struct stat found;
    size_t needed = (size_t)ring->distance * ring->slots;
    if (fstat(memory, &found) != 0)
        return fail(feed, "cannot look at holod's memory: %s", strerror(errno));
    if (found.st_size < 0 || (uint64_t)found.st_size < needed)
        return fail(feed, "holod's memory has %lld bytes, expected %zu: report this",
                    (long long)found.st_size, needed);
    void *mapped = mmap(NULL, needed, PROT_READ | PROT_WRITE, MAP_SHARED, memory, 0);
    if (mapped == MAP_FAILED)
        return fail(feed, "cannot map %zu bytes of holod's memory: %s", needed, strerror(errno));
    feed->memory = mapped;
    feed->memory_bytes = needed;
    feed->free_slots = UINT64_MAX >> (MOST_SLOTS - ring->slots);
    return HOLOD_FEED_OK;
}

static enum holod_feed_result receive_ring(struct holod_feed *feed,
                                           const struct holod_feed_format *format)
{
    struct message message;
    int memory = -1;
    enum holod_feed_result result =
        receive(feed, deadline_ms(ANSWER_TIMEOUT_S * 1000), &message, &memory);
    if (result == HOLOD_FEED_TIMEOUT) {
        result = fail(feed, "holod said nothing on %s for %d s: see its log, start it again",
                      feed->path, ANSWER_TIMEOUT_S);
    } else if (result == HOLOD_FEED_OK) {
        if (message.length != sizeof feed->ring || memcmp(message.bytes, "RING", 4) != 0) {
            result = unexpected(feed, &message, "RING of 48 bytes");
        } else {
            memcpy(&feed->ring, message.bytes, sizeof feed->ring);
            result = map_memory(feed, format, memory);
        }
    }
    if (memory >= 0)
        close(memory);
    return result;
}

/* The interface */

enum holod_feed_result holod_feed_open(const char *path, const struct holod_feed_format *format,
                                       struct holod_feed **feed)
{
    struct holod_feed *opened = calloc(1, sizeof *opened);
    *feed = opened;
    if (!opened)
        return HOLOD_FEED_FAILED;
    opened->socket = -1;
    opened->begun = -1;
    opened->outcomes.refusal = opened->refusal;
    opened->tells_view = format->tells_view != 0;
    opened->view.focus_dpt = -1;

    bool is_nobody;
    enum holod_feed_result result =
        path ? connect_to(opened, path, &is_nobody) : connect_to_any(opened);
    if (result == HOLOD_FEED_OK)
        result = say_hello(opened, format);
    if (result == HOLOD_FEED_OK)
        result = receive_ring(opened, format);
    return result;
}

enum holod_feed_result holod_feed_begin(struct holod_feed *feed, int timeout_ms,
                                        struct holod_feed_slot *slot)
{
    if (feed->socket < 0)
        return HOLOD_FEED_FAILED;
    int64_t deadline = deadline_ms(timeout_ms);
    enum holod_feed_result result = receive_what_is_there(feed);
    while (result == HOLOD_FEED_OK && feed->begun < 0 && feed->free_slots == 0)
        result = receive_free(feed, deadline);
    if (result == HOLOD_FEED_TIMEOUT)
        return report(feed, result, "holod has kept all %" PRIu32 " slots for %d ms: is it busy?",
                      feed->ring.slots, timeout_ms);
    if (result != HOLOD_FEED_OK)
        return result;

    if (feed->begun < 0) {
        feed->begun = 0;
        while (!(feed->free_slots >> feed->begun & 1))
            feed->begun++;
        feed->free_slots &= ~(UINT64_C(1) << feed->begun);
    }
    const struct ring *ring = &feed->ring;
    unsigned char *start = feed->memory + (size_t)ring->distance * (size_t)feed->begun;
    slot->colour = start + ring->colour_offset;
    slot->colour_bytes = (size_t)ring->colour_bytes;
    slot->depth = ring->depth_bytes ? start + ring->depth_offset : NULL;
    slot->depth_bytes = (size_t)ring->depth_bytes;
    return HOLOD_FEED_OK;
}

enum holod_feed_result holod_feed_set_view(struct holod_feed *feed,
                                           const struct holod_feed_view *view)
{
    static const struct holod_feed_view unknown = {.focus_dpt = -1};
    if (!view) {
        feed->view = unknown;
        return HOLOD_FEED_OK;
    }
    if (!feed->tells_view)
        return report(feed, HOLOD_FEED_FAILED, "the feed was opened without tells_view");
    if (!(view->focus_dpt <= NEAREST_DPT))
        return report(feed, HOLOD_FEED_FAILED,
                      "a focus of %g dioptres was given, expected 0 (infinity) to %d, or less than 0 "
                      "where it is not known",
                      (double)view->focus_dpt, NEAREST_DPT);
    bool has_field = view->across_deg != 0 || view->up_deg != 0;
    bool is_field = view->across_deg > 0 && view->across_deg < 180 && view->up_deg > 0 &&
                    view->up_deg < 180;
    if (has_field && !is_field)
        return report(feed, HOLOD_FEED_FAILED,
                      "a field of view of %g x %g degrees was given, expected two angles between 0 "
                      "and 180, or 0 x 0 where it is not known",
                      (double)view->across_deg, (double)view->up_deg);
    feed->view = *view;
    return HOLOD_FEED_OK;
}

enum holod_feed_result holod_feed_send(struct holod_feed *feed, int64_t t_capture_ns)
{
    if (feed->socket < 0)
        return HOLOD_FEED_FAILED;
    if (feed->begun < 0)
        return report(feed, HOLOD_FEED_FAILED, "no picture was begun: call holod_feed_begin first");
    struct fram fram = {
        .kind = {'F', 'R', 'A', 'M'},
        .slot = (uint32_t)feed->begun,
        .sequence = feed->sequence + 1,
        .t_capture_ns = t_capture_ns,
    };
    if (feed->view.focus_dpt >= 0) {
        fram.given |= HAS_FOCUS;
        fram.focus_dpt = feed->view.focus_dpt;
    }
    if (feed->view.across_deg > 0) {
        fram.given |= HAS_FIELD_OF_VIEW;
        fram.across_deg = feed->view.across_deg;
        fram.up_deg = feed->view.up_deg;
    }
    enum holod_feed_result result = send_message(feed, &fram, sizeof fram);
    if (result != HOLOD_FEED_OK)
        return result;
    feed->sequence++;
    feed->begun = -1;
    feed->outcomes.sent++;
    return HOLOD_FEED_OK;
}

void holod_feed_leave_out(struct holod_feed *feed, uint64_t pictures)
{
    feed->sequence += pictures;
}

static uint64_t unknown_outcomes(const struct holod_feed *feed)
{
    const struct holod_feed_outcomes *seen = &feed->outcomes;
    return seen->sent - seen->taken - seen->overtaken - seen->refused - seen->not_shown;
}

enum holod_feed_result holod_feed_wait(struct holod_feed *feed, int timeout_ms)
{
    if (feed->socket < 0)
        return HOLOD_FEED_FAILED;
    int64_t deadline = deadline_ms(timeout_ms);
    enum holod_feed_result result = receive_what_is_there(feed);
    while (result == HOLOD_FEED_OK && unknown_outcomes(feed) > 0)
        result = receive_free(feed, deadline);
    if (result == HOLOD_FEED_TIMEOUT)
        return report(feed, result,
                      "holod has not said in %d ms what became of %" PRIu64
                      " pictures: is it busy?",
                      timeout_ms, unknown_outcomes(feed));
    return result;
}

const struct holod_feed_outcomes *holod_feed_outcomes(const struct holod_feed *feed)
{
    return &feed->outcomes;
}

const char *holod_feed_error(const struct holod_feed *feed)
{
    return feed ? feed->error : "no memory for a feed";
}

void holod_feed_close(struct holod_feed *feed)
{
    if (!feed)
        return;
    if (feed->socket >= 0)
        close(feed->socket);
    if (feed->memory)
        munmap(feed->memory, feed->memory_bytes);
    free(feed);
}
