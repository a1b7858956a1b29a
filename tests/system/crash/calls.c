/* Sees every call by which a process changes files under one folder, and does to the process what was ordered.

   Loaded by LD_PRELOAD into an interpreter that runs the program as it is: h5py's own writes are seen as well. A call
   is numbered from 1; at number `at` the process is killed before it, or in the midst of a write and after what is no
   write, or stopped, or the call fails, once or from then on. Calls may be logged, with what they wrote, for the replay
   of power cuts. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

enum { WATCH, KILL_BEFORE, KILL_WITHIN, STOP_BEFORE, FAIL_ONCE, FAIL_ON };
enum { WRITE = 1, SYNC, RESIZE, RESERVE, LINK, RENAME, UNLINK, MKDIR, RMDIR, CREATE };

struct entry { /* of the log; then the path, the second path and what was written */
    uint32_t kind, path_bytes, other_bytes, data_bytes;
    uint64_t offset, inode;
};

static char folder[4096];
static int log_fd = -1, mode = WATCH, failure = ENOSPC;
static long at = 0, part = 0, calls = 0;
static pthread_mutex_t turn = PTHREAD_MUTEX_INITIALIZER;

void crash_order(const char *where, int how, long call, long bytes, int error, int log)
{
    strncpy(folder, where, sizeof folder - 1);
    mode = how, at = call, part = bytes, failure = error, log_fd = log, calls = 0;
}

long crash_calls(void) { return calls; }

static int ours(const char *path)
{
    size_t size = strlen(folder);
    return size && !strncmp(path, folder, size) && (!path[size] || path[size] == '/');
}

static int path_of(int fd, char *path, size_t size)
{
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t count = syscall(SYS_readlinkat, AT_FDCWD, link, path, size - 1);
    path[count > 0 ? count : 0] = 0;
    return count > 0 && ours(path);
}

static int path_at(int base, const char *name, char *path, size_t size)
{
    char start[2048] = "";
    if (name[0] != '/') {
        if (base == AT_FDCWD) {
            if (!getcwd(start, sizeof start)) return 0;
        } else {
            char link[64];
            snprintf(link, sizeof link, "/proc/self/fd/%d", base);
            ssize_t count = syscall(SYS_readlinkat, AT_FDCWD, link, start, sizeof start - 1);
            start[count > 0 ? count : 0] = 0;
        }
    }
    snprintf(path, size, "%s%s%s", start, start[0] ? "/" : "", name);
    return ours(path);
}

static void die(void)
{
    syscall(SYS_kill, syscall(SYS_getpid), SIGKILL);
    for (;;) pause();
}

static void put(const void *bytes, size_t size)
{
    while (size) {
        ssize_t count = syscall(SYS_write, log_fd, bytes, size);
        if (count <= 0) return;
        bytes = (const char *)bytes + count, size -= (size_t)count;
    }
}

static void note(int kind, int fd, const char *path, const char *other, uint64_t offset, const void *data, size_t size)
{
    if (log_fd < 0) return;
    struct stat found = {0};
    if (fd >= 0) fstat(fd, &found);
    else lstat(other ? other : path, &found);
    struct entry entry = {kind, strlen(path), other ? strlen(other) : 0, data ? size : 0, offset, found.st_ino};
    put(&entry, sizeof entry);
    put(path, entry.path_bytes);
    if (other) put(other, entry.other_bytes);
    if (data) put(data, size);
}

/* Called with `turn` held; 1 when the call is to fail. A full disk keeps nobody from removing names. */
static int begin(int kind)
{
    calls++;
    int removes = kind == UNLINK || kind == RMDIR;
    if (!(failure == ENOSPC && removes) && (mode == FAIL_ON ? calls >= at : mode == FAIL_ONCE && calls == at)) {
        errno = failure;
        return 1;
    }
    if (calls != at) return 0;
    if (mode == KILL_BEFORE) die();
    if (mode == STOP_BEFORE) syscall(SYS_kill, syscall(SYS_getpid), SIGSTOP);
    return 0;
}

static void end(void)
{
    if (calls == at && mode == KILL_WITHIN) die();
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
/* What is no write has no midst: it is killed after. */
#define GUARDED(condition, kind, real, record)    \
    if (!(condition)) return real;                \
    pthread_mutex_lock(&turn);                    \
    if (begin(kind)) {                            \
        int told = errno;                         \
        pthread_mutex_unlock(&turn);              \
        errno = told;                             \
        return -1;                                \
    }                                             \
    __typeof__(real) result = real;               \
    int told = errno;                             \
    if (result >= 0) record;                      \
    end();                                        \
    pthread_mutex_unlock(&turn);                  \
    errno = told;                                 \
    return result

/* Where it lands is noted, also in a file opened to append. */
static ssize_t store(int fd, const void *data, size_t size, off_t *offset, int positioned)
{
    if (calls == at && mode == KILL_WITHIN && (size_t)part < size) size = (size_t)part;
    if (positioned) return syscall(SYS_pwrite64, fd, data, size, *offset);
    struct stat found;
    fstat(fd, &found);
    *offset = fcntl(fd, F_GETFL) & O_APPEND ? found.st_size : syscall(SYS_lseek, fd, 0, SEEK_CUR);
    return syscall(SYS_write, fd, data, size);
}

static ssize_t written(int fd, const void *data, size_t size, off_t offset, int positioned)
{
    char path[4096];
    GUARDED(path_of(fd, path, sizeof path), WRITE, store(fd, data, size, &offset, positioned),
            note(WRITE, fd, path, NULL, offset, data, result));
}

ssize_t write(int fd, const void *data, size_t size) { return written(fd, data, size, 0, 0); }
ssize_t pwrite(int fd, const void *data, size_t size, off_t offset) { return written(fd, data, size, offset, 1); }
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t offset) { return written(fd, data, size, offset, 1); }

#define ON_FD(name, signature, call, kind, offset)                                            \
    int name signature                                                                        \
    {                                                                                         \
        char path[4096];                                                                      \
        GUARDED(path_of(fd, path, sizeof path), kind, call, note(kind, fd, path, NULL, offset, NULL, 0)); \
    }
ON_FD(fsync, (int fd), (int)syscall(SYS_fsync, fd), SYNC, 0)
ON_FD(fdatasync, (int fd), (int)syscall(SYS_fdatasync, fd), SYNC, 0)
ON_FD(ftruncate, (int fd, off_t size), (int)syscall(SYS_ftruncate, fd, size), RESIZE, size)
ON_FD(ftruncate64, (int fd, off64_t size), (int)syscall(SYS_ftruncate, fd, size), RESIZE, size)

static int reserve(int fd, off_t start, off_t size)
{
    char path[4096];
    if (!path_of(fd, path, sizeof path)) return REAL(posix_fallocate)(fd, start, size);
    pthread_mutex_lock(&turn);
    int result = begin(RESERVE) ? failure : REAL(posix_fallocate)(fd, start, size); /* it returns the error */
    if (!result) {
        note(RESERVE, fd, path, NULL, start + size, NULL, 0);
        end();
    }
    pthread_mutex_unlock(&turn);
    return result;
}
int posix_fallocate(int fd, off_t start, off_t size) { return reserve(fd, start, size); }
int posix_fallocate64(int fd, off64_t start, off64_t size) { return reserve(fd, start, size); }

#define ON_PATH(name, signature, base, from, call, kind)                                                   \
    int name signature                                                                                     \
    {                                                                                                      \
        char path[4096];                                                                                   \
        GUARDED(path_at(base, from, path, sizeof path), kind, call, note(kind, -1, path, NULL, 0, NULL, 0)); \
    }
ON_PATH(unlink, (const char *name), AT_FDCWD, name, (int)syscall(SYS_unlinkat, AT_FDCWD, name, 0), UNLINK)
ON_PATH(unlinkat, (int base, const char *name, int flags), base, name,
        (int)syscall(SYS_unlinkat, base, name, flags), flags &AT_REMOVEDIR ? RMDIR : UNLINK)
ON_PATH(rmdir, (const char *name), AT_FDCWD, name, (int)syscall(SYS_unlinkat, AT_FDCWD, name, AT_REMOVEDIR), RMDIR)
ON_PATH(mkdir, (const char *name, mode_t rights), AT_FDCWD, name,
        (int)syscall(SYS_mkdirat, AT_FDCWD, name, rights), MKDIR)
ON_PATH(mkdirat, (int base, const char *name, mode_t rights), base, name,
        (int)syscall(SYS_mkdirat, base, name, rights), MKDIR)

#define ON_PATHS(name, signature, base, from, to_base, to, call, kind)          \
    int name signature                                                          \
    {                                                                           \
        char path[4096], other[4096];                                           \
        path_at(base, from, path, sizeof path);                                 \
        GUARDED(path_at(to_base, to, other, sizeof other), kind, call,           \
                note(kind, -1, path, other, 0, NULL, 0));                       \
    }
ON_PATHS(link, (const char *from, const char *to), AT_FDCWD, from, AT_FDCWD, to,
         (int)syscall(SYS_linkat, AT_FDCWD, from, AT_FDCWD, to, 0), LINK)
ON_PATHS(linkat, (int base, const char *from, int to_base, const char *to, int flags), base, from, to_base, to,
         (int)syscall(SYS_linkat, base, from, to_base, to, flags), LINK)
ON_PATHS(rename, (const char *from, const char *to), AT_FDCWD, from, AT_FDCWD, to,
         (int)syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0), RENAME)
ON_PATHS(renameat, (int base, const char *from, int to_base, const char *to), base, from, to_base, to,
         (int)syscall(SYS_renameat2, base, from, to_base, to, 0), RENAME)

static int opened(int base, const char *name, int flags, mode_t rights)
{
    char path[4096];
    GUARDED(flags & (O_CREAT | O_TRUNC) && path_at(base, name, path, sizeof path), CREATE,
            (int)syscall(SYS_openat, base, name, flags, rights),
            note(CREATE, result, path, NULL, flags & O_TRUNC ? 1 : 0, NULL, 0));
}

#define RIGHTS                       \
    mode_t rights = 0;               \
    if (flags & O_CREAT) {           \
        va_list rest;                \
        va_start(rest, flags);       \
        rights = va_arg(rest, mode_t); \
        va_end(rest);                \
    }
int open(const char *name, int flags, ...) { RIGHTS return opened(AT_FDCWD, name, flags, rights); }
int open64(const char *name, int flags, ...) { RIGHTS return opened(AT_FDCWD, name, flags | O_LARGEFILE, rights); }
int openat(int base, const char *name, int flags, ...) { RIGHTS return opened(base, name, flags, rights); }
int openat64(int base, const char *name, int flags, ...) { RIGHTS return opened(base, name, flags | O_LARGEFILE, rights); }
