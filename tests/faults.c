/* SPDX-License-Identifier: MIT
 * Preloaded: file calls below FAULT_PATH fail, and the clock is off.
 * FAULT_CALL: write, fsync, rename, open or read; FAULT_ERRNO; from the FAULT_NTH-th call on (from
 * 0), FAULT_TIMES times. FAULT_CLOCK_S: added to the time of day. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static atomic_long calls;

static int below(const char *path) {
    const char *place = getenv("FAULT_PATH");
    return place && path && !strncmp(path, place, strlen(place));
}

static int of_fd(int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return below(path);
}

static int fails(const char *name) {
    const char *call = getenv("FAULT_CALL"), *times = getenv("FAULT_TIMES");
    if (!call || strcmp(call, name)) return 0;
    long number = atomic_fetch_add(&calls, 1), first = atol(getenv("FAULT_NTH"));
    if (number < first || number >= first + (times ? atol(times) : 1)) return 0;
    errno = atoi(getenv("FAULT_ERRNO"));
    return 1;
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int fd, const void *data, size_t size) {
    int saved = errno;
    if (of_fd(fd) && fails("write")) return -1;
    errno = saved;
    return NEXT(write)(fd, data, size);
}

ssize_t read(int fd, void *data, size_t size) {
    int saved = errno;
    if (of_fd(fd) && fails("read")) return -1;
    errno = saved;
    return NEXT(read)(fd, data, size);
}

int fsync(int fd) {
    if (of_fd(fd) && fails("fsync")) return -1;
    return NEXT(fsync)(fd);
}

int rename(const char *from, const char *to) {
    if (below(to) && fails("rename")) return -1;
    return NEXT(rename)(from, to);
}

int open64(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    int mode = va_arg(rest, int);
    va_end(rest);
    if (below(path) && fails("open")) return -1;
    return NEXT(open64)(path, flags, mode);
}

int open(const char *path, int flags, ...) {
    va_list rest;
    va_start(rest, flags);
    int mode = va_arg(rest, int);
    va_end(rest);
    if (below(path) && fails("open")) return -1;
    return NEXT(open)(path, flags, mode);
}

time_t time(time_t *into) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (into) *into = now.tv_sec;
    return now.tv_sec;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    int code = NEXT(clock_gettime)(clock, now);
    const char *off = getenv("FAULT_CLOCK_S");
    if (!code && off && clock == CLOCK_REALTIME) now->tv_sec += atol(off);
    return code;
}
