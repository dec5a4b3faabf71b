/* The tug's controller in C, without any library: turns to the goal, and drives there.
 *
 * `make` builds it. In virtual time nodes.Controller takes its place; a test compares the two.
 */
#include <math.h>
#include <poll.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>

static double limited(double value, double most)
{
    return fmin(fmax(value, -most), most);
}

/* Send a heartbeat: WATCHDOG=1 of sd_notify(3). */
static void beat(int notify)
{
    struct sockaddr_un to = {.sun_family = AF_UNIX};
    const char *name = getenv("NOTIFY_SOCKET");
    if (!name || strlen(name) >= sizeof to.sun_path)
        return;
    strcpy(to.sun_path, name);
    if (name[0] == '@')
        to.sun_path[0] = '\0'; /* an abstract address */
    sendto(notify, "WATCHDOG=1", 10, MSG_DONTWAIT, (struct sockaddr *)&to,
           offsetof(struct sockaddr_un, sun_path) + strlen(name));
}

int main(void)
{
    const char *given = getenv("RAMPART_SOCKET");
    if (!given) {
        fprintf(stderr, "RAMPART_SOCKET is not set: this is a node of a Rampart system\n");
        return 2;
    }
    int rampart = atoi(given); /* an open descriptor: one packet is one message */
    int notify = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    double goal_x_m = 1.0, goal_y_m = 0.9, goal_s = 0.0; /* the dock, until a goal arrives */
    for (;;) {
        beat(notify);
        struct pollfd ready = {.fd = rampart, .events = POLLIN};
        if (poll(&ready, 1, 100) == 0)
            continue;
        char packet[4096], out[200];
        ssize_t size = recv(rampart, packet, sizeof packet - 1, 0);
        if (size <= 0)
            return 0; /* the other end is closed */
        packet[size] = '\0';
        double stamp_s, x_m, y_m, heading_rad; /* SOURCE and INCARNATION follow the stamp */
        if (sscanf(packet, "mission/goal %lf %*s %*d {\"step\":%*d,\"x_m\":%lf,\"y_m\":%lf", &stamp_s,
                   &x_m, &y_m) == 3) {
            goal_x_m = x_m, goal_y_m = y_m, goal_s = stamp_s;
        } else if (sscanf(packet, "localization/pose %lf %*s %*d {\"x_m\":%lf,\"y_m\":%lf,\"heading_rad\":%lf",
                          &stamp_s, &x_m, &y_m, &heading_rad) == 4) {
            double dx = goal_x_m - x_m, dy = goal_y_m - y_m, away_m = hypot(dx, dy);
            double turn = remainder(atan2(dy, dx) - heading_rad, 2 * M_PI);
            double speed_mps = fabs(turn) < 0.3 ? fmin(0.8, 0.8 * away_m) : 0.0;
            double turn_radps = fmin(1.0, 4.0 * away_m) * limited(2.0 * turn, 1.0);
            /* The output has the time stamp of its inputs. */
            size = snprintf(out, sizeof out, "controller/motion %.9f\n{\"speed_mps\":%.9f,\"turn_radps\":%.9f}",
                            fmin(stamp_s, goal_s + 0.2), speed_mps, turn_radps);
            if (send(rampart, out, size, MSG_DONTWAIT) < 0)
                perror("controller/motion is not sent");
        }
    }
}
