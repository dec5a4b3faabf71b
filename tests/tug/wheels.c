/* A node of a Rampart system in C, without any library: it turns speeds into those of the wheels. */
#include <poll.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

static int notify = -1;                 /* to $NOTIFY_SOCKET, see sd_notify(3) */
static struct sockaddr_un manager = {.sun_family = AF_UNIX};
static socklen_t manager_size;

static void open_notify(void)
{
    const char *name = getenv("NOTIFY_SOCKET");
    if (!name || strlen(name) >= sizeof manager.sun_path)
        return;
    strcpy(manager.sun_path, name);
    manager_size = offsetof(struct sockaddr_un, sun_path) + strlen(name);
    if (name[0] == '@')
        manager.sun_path[0] = '\0';     /* an abstract address */
    notify = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
}

static void tell(const char *what)
{
    if (notify >= 0)
        sendto(notify, what, strlen(what), MSG_DONTWAIT, (struct sockaddr *)&manager, manager_size);
}

int main(void)
{
    const double radius_m = 0.1, half_track_m = 0.25;
    double speed_mps = 0, turn_radps = 0;
    const char *given = getenv("RAMPART_SOCKET");
    if (!given) {
        fprintf(stderr, "RAMPART_SOCKET is not set: this is a node of a Rampart system\n");
        return 2;
    }
    int rampart = atoi(given);          /* an open descriptor: one packet is one message */
    open_notify();
    tell("READY=1");
    for (;;) {
        struct pollfd ready = {.fd = rampart, .events = POLLIN};
        if (poll(&ready, 1, 20) > 0) {
            char packet[4096], key[100];
            ssize_t size = recv(rampart, packet, sizeof packet - 1, 0);
            if (size <= 0)
                return 0;               /* the other end is closed */
            packet[size] = '\0';
            double stamp_s;             /* simulated seconds at which it was true */
            const char *body = strchr(packet, '\n');
            if (body && sscanf(packet, "%99s %lf", key, &stamp_s) == 2 && !strcmp(key, "tug/command"))
                sscanf(body, "\n{\"speed_mps\":%lf,\"turn_radps\":%lf", &speed_mps, &turn_radps);
        }
        char said[200];
        int size = snprintf(said, sizeof said, "tug/wheels\n{\"left_radps\":%.6f,\"right_radps\":%.6f}",
                            (speed_mps - turn_radps * half_track_m) / radius_m,
                            (speed_mps + turn_radps * half_track_m) / radius_m);
        if (send(rampart, said, size, MSG_DONTWAIT) < 0)
            perror("tug/wheels is not sent");
        tell("WATCHDOG=1");
    }
}
