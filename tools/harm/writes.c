/* For tools/faults: makes one write below a directory fail, once. Loaded into a run with LD_PRELOAD; told by
     WRITES_BELOW   the directory
     WRITES_LOG     a file outside of it, which gets a line for each write that is seen: what, and where it is
     WRITES_FAIL    the number of the one that fails, from 1; none without it
     WRITES_ERROR   errno it fails with
   A write is all that may find a disk full or broken: opening for writing, writing, truncating, syncing, renaming,
   making a directory. What C's own streams write is not seen; Python, orbax and tensorstore use none. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static const char *below;
static size_t length;
static int log_fd = -1, error_number;
static long failing;
static atomic_long seen;

__attribute__((constructor)) static void begin(void) {
    const char *log = getenv("WRITES_LOG"), *number = getenv("WRITES_FAIL"), *error = getenv("WRITES_ERROR");
    below = getenv("WRITES_BELOW");
    length = below ? strlen(below) : 0;
    failing = number ? atol(number) : 0;
    error_number = error ? atoi(error) : ENOSPC;
    if (log) log_fd = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
}

/* Whether a write to `path` is the one that fails. */
static int fails(const char *what, const char *path) {
    char line[PATH_MAX + 32];
    if (!length || strncmp(path, below, length) || (path[length] && path[length] != '/')) return 0;
    long number = atomic_fetch_add(&seen, 1) + 1;
    int written = snprintf(line, sizeof line, "%s %s\n", what, path[length] ? path + length + 1 : ".");
    if (log_fd >= 0 && written > 0) syscall(SYS_write, log_fd, line, (size_t)written);
    if (number != failing) return 0;
    errno = error_number;
    return 1;
}

static int fails_at(const char *what, int directory, const char *path) {
    char whole[PATH_MAX * 2], link[64], at[PATH_MAX] = "";
    ssize_t size;
    if (!length || !path) return 0;
    if (path[0] == '/') return fails(what, path);
    if (directory == AT_FDCWD) snprintf(link, sizeof link, "/proc/self/cwd");
    else snprintf(link, sizeof link, "/proc/self/fd/%d", directory);
    if ((size = readlink(link, at, sizeof at - 1)) < 0) return 0;
    at[size] = 0;
    snprintf(whole, sizeof whole, "%s/%s", at, path);
    return fails(what, whole);
}

static int fails_on(const char *what, int file) {
    char link[64], path[PATH_MAX];
    int before = errno;
    ssize_t size;
    if (!length) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    size = readlink(link, path, sizeof path - 1);
    errno = before;
    if (size < 0) return 0;
    path[size] = 0;
    return fails(what, path);
}

#define ORIGINAL(result, name, ...)                             \
    static result (*original)(__VA_ARGS__);                     \
    if (!original) original = (result(*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

#define WRITES(flags) (((flags) & O_ACCMODE) != O_RDONLY || ((flags) & (O_CREAT | O_TRUNC)))
#define MODE(flags)                                             \
    mode_t mode = 0;                                            \
    if ((flags) & (O_CREAT | __O_TMPFILE)) {                    \
        va_list more;                                           \
        va_start(more, flags);                                  \
        mode = va_arg(more, mode_t);                            \
        va_end(more);                                           \
    }

#define OPEN(name)                                              \
    int name(const char *path, int flags, ...) {                \
        MODE(flags)                                             \
        ORIGINAL(int, #name, const char *, int, ...);           \
        if (WRITES(flags) && fails_at("open", AT_FDCWD, path)) return -1; \
        return original(path, flags, mode);                     \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                            \
    int name(int directory, const char *path, int flags, ...) { \
        MODE(flags)                                             \
        ORIGINAL(int, #name, int, const char *, int, ...);      \
        if (WRITES(flags) && fails_at("open", directory, path)) return -1; \
        return original(directory, path, flags, mode);          \
    }
OPENAT(openat)
OPENAT(openat64)

#define ON_FILE(result, name, what, parameters, types, arguments) \
    result name parameters {                                    \
        static result(*original) types;                         \
        if (!original) original = (result(*) types)dlsym(RTLD_NEXT, #name); \
        if (fails_on(what, file)) return -1;                    \
        return original arguments;                              \
    }
ON_FILE(ssize_t, write, "write", (int file, const void *data, size_t size), (int, const void *, size_t),
        (file, data, size))
ON_FILE(ssize_t, writev, "write", (int file, const struct iovec *data, int count), (int, const struct iovec *, int),
        (file, data, count))
ON_FILE(ssize_t, pwrite, "write", (int file, const void *data, size_t size, off_t at),
        (int, const void *, size_t, off_t), (file, data, size, at))
ON_FILE(ssize_t, pwrite64, "write", (int file, const void *data, size_t size, off64_t at),
        (int, const void *, size_t, off64_t), (file, data, size, at))
ON_FILE(ssize_t, pwritev, "write", (int file, const struct iovec *data, int count, off_t at),
        (int, const struct iovec *, int, off_t), (file, data, count, at))
ON_FILE(ssize_t, pwritev64, "write", (int file, const struct iovec *data, int count, off64_t at),
        (int, const struct iovec *, int, off64_t), (file, data, count, at))
ON_FILE(int, fsync, "sync", (int file), (int), (file))
ON_FILE(int, fdatasync, "sync", (int file), (int), (file))
ON_FILE(int, ftruncate, "truncate", (int file, off_t size), (int, off_t), (file, size))
ON_FILE(int, ftruncate64, "truncate", (int file, off64_t size), (int, off64_t), (file, size))

int mkdir(const char *path, mode_t mode) {
    ORIGINAL(int, "mkdir", const char *, mode_t);
    return fails_at("mkdir", AT_FDCWD, path) ? -1 : original(path, mode);
}

int mkdirat(int directory, const char *path, mode_t mode) {
    ORIGINAL(int, "mkdirat", int, const char *, mode_t);
    return fails_at("mkdir", directory, path) ? -1 : original(directory, path, mode);
}

int rename(const char *from, const char *to) {
    ORIGINAL(int, "rename", const char *, const char *);
    return fails_at("rename", AT_FDCWD, to) ? -1 : original(from, to);
}

int renameat(int from_directory, const char *from, int directory, const char *to) {
    ORIGINAL(int, "renameat", int, const char *, int, const char *);
    return fails_at("rename", directory, to) ? -1 : original(from_directory, from, directory, to);
}

int renameat2(int from_directory, const char *from, int directory, const char *to, unsigned flags) {
    ORIGINAL(int, "renameat2", int, const char *, int, const char *, unsigned);
    return fails_at("rename", directory, to) ? -1 : original(from_directory, from, directory, to, flags);
}
