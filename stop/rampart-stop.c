/* rampart-stop IN OUT TIMEOUT_MS PERIOD_MS METRES_PER_S RADIANS_PER_S
 *
 * Runs beside the driver of the base. Hands a velocity on while it is fresh, bounded and in sequence, and
 * zero otherwise, one frame per period. IN and OUT are Unix datagram sockets: IN is created with mode
 * 0600, OUT belongs to the driver. A frame has 56 bytes in the byte order of the machine; times are those
 * of CLOCK_MONOTONIC in ns:
 *    0  char[4]  "RPV1"
 *    4  uint32   CRC-32 (zlib) of bytes 8 to 55
 *    8  uint64   session: when the sender started; only the newest session counts
 *   16  uint64   sequence number within the session
 *   24  uint64   stamp: when the velocity was computed, not when it was sent
 *   32  double   x and y, m/s, in the frame of the base; then the turn rate, rad/s
 * A velocity that is not finite or out of bounds makes the output zero at once, silence and old stamps
 * after the timeout. The driver needs a timeout of its own, for the death of this program. Exit code: 0
 * after SIGTERM or SIGINT, with a last zero; 1 if IN cannot be created; 2 for wrong usage. */
#define _GNU_SOURCE
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#define SECOND 1000000000u
struct frame { char magic[4]; uint32_t crc; uint64_t session, sequence, stamp; double x, y, turn; };
_Static_assert(sizeof(struct frame) == 56, "the frame has no padding");

static uint64_t timeout, period;    /* ns */
static double linear, angular;      /* bounds, m/s and rad/s */
static volatile sig_atomic_t ended;
static struct frame newest;         /* the last accepted frame */
static uint64_t fresh_until;        /* 0 if it must not be handed on */

static void end(int number) { ended = number; }

static uint64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t)t.tv_sec * SECOND + (uint64_t)t.tv_nsec;
}

static uint32_t crc(const struct frame *f)
{
    uint32_t sum = ~0u;
    for (size_t i = 8; i < sizeof *f; i++) {
        sum ^= ((const unsigned char *)f)[i];
        for (int bit = 0; bit < 8; bit++)
            sum = sum >> 1 ^ (sum & 1 ? 0xEDB88320u : 0);
    }
    return ~sum;
}

/* Accept a frame, or return why it is refused. A comparison with NaN is false. */
static const char *take(const struct frame *f, ssize_t size, uint64_t at)
{
    if (size != sizeof *f || memcmp(f->magic, "RPV1", 4) || f->crc != crc(f))
        return "damaged frame";
    if (f->session < newest.session || f->session > at)
        return "frame of another session";
    if (f->session == newest.session && (f->sequence <= newest.sequence || f->stamp < newest.stamp))
        return "repeated frame";
    if (f->stamp > at || at - f->stamp > timeout)
        return "stale frame";
    newest = *f;
    fresh_until = 0;
    if (!(f->x * f->x + f->y * f->y <= linear * linear && f->turn * f->turn <= angular * angular))
        return "velocity out of bounds";
    fresh_until = f->stamp + timeout;
    return NULL;
}

static void fail(int code, const char *subject, const char *problem)
{
    fprintf(stderr, "rampart-stop: %s: %s\n", subject, problem);
    exit(code);
}

static double number(const char *text, double least, double most)
{
    char *rest;
    double value = strtod(text, &rest);
    if (!*text || *rest || !(value >= least && value <= most))      /* NaN, too */
        fail(2, text, "expected 1 to 10000 ms, 1 to 1000 ms, 0 to 100 m/s, 0 to 100 rad/s");
    return value;
}

static struct sockaddr_un address(const char *path)
{
    struct sockaddr_un made = { .sun_family = AF_UNIX };
    if (!*path || strlen(path) >= sizeof made.sun_path)
        fail(2, path, "expected a path of 1 to 107 characters");
    strcpy(made.sun_path, path);
    return made;
}

int main(int argc, char **argv)
{
    if (argc != 7)
        fail(2, "usage", "rampart-stop IN OUT TIMEOUT_MS PERIOD_MS METRES_PER_S RADIANS_PER_S");
    timeout = (uint64_t)(number(argv[3], 1, 10000) * 1e6);
    period = (uint64_t)(number(argv[4], 1, 1000) * 1e6);
    linear = number(argv[5], 0, 100), angular = number(argv[6], 0, 100);
    struct sockaddr_un in = address(argv[1]), out = address(argv[2]);
    int fd = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
    struct stat earlier;
    if (!lstat(argv[1], &earlier) && S_ISSOCK(earlier.st_mode))
        unlink(argv[1]);
    umask(0177);                            /* IN is for this user only */
    if (fd < 0 || bind(fd, (struct sockaddr *)&in, sizeof in))
        fail(1, argv[1], "cannot be created");
    signal(SIGTERM, end), signal(SIGINT, end);
    mlockall(MCL_CURRENT | MCL_FUTURE);     /* this and the next line help where they are permitted */
    sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){ .sched_priority = 10 });
    struct frame sent = { .magic = { 'R', 'P', 'V', '1' }, .session = now() };
    const char *why = "no frame yet", *refused;
    int handed_on = 1;
    for (uint64_t due = now(), at, told = 0, last = 0; !last; due = (at > due + period ? at : due) + period) {
        while (!ended && (at = now()) < due) {
            struct timespec left = { (time_t)((due - at) / SECOND), (long)((due - at) % SECOND) };
            struct { struct frame frame; char more; } got;
            ssize_t size;       /* of a longer datagram: one byte more than a frame */
            if (ppoll(&(struct pollfd){ .fd = fd, .events = POLLIN }, 1, &left, NULL) == 1 &&
                (size = recv(fd, &got, sizeof got.frame + 1, 0)) >= 0 &&
                (refused = take(&got.frame, size, now())))
                why = refused;
        }
        at = now();
        last = (uint64_t)ended;
        int hands_on = !last && at <= fresh_until;
        sent = (struct frame){ "RPV1", 0, sent.session, sent.sequence + 1, at, 0, 0, 0 };
        if (hands_on)
            sent.x = newest.x, sent.y = newest.y, sent.turn = newest.turn;
        sent.crc = crc(&sent);
        sendto(fd, &sent, sizeof sent, MSG_DONTWAIT, (struct sockaddr *)&out, sizeof out);
        if (hands_on != handed_on && at - told >= SECOND) {     /* a line a second at most */
            fprintf(stderr, "rampart-stop: %s%s\n", hands_on ? "hands on" : "zero: ", hands_on ? "" : why);
            handed_on = hands_on, told = at, why = "no fresh frame";
        }
    }
    unlink(argv[1]);
    return 0;
}
