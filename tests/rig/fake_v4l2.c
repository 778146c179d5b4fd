/* A V4L2 device for tests, put before the C library: the file named by FAKE_V4L2 is a camera.
 *
 * It has 30 or 100 frames a second of 64 x 48 pixels, YUYV or GREY, four buffers, and says how it
 * is to misbehave by FAKE_V4L2_FAULT: "none", "stall" or "gone" after 40 frames, "drop" one of ten,
 * "slow": half the rate that it answered to VIDIOC_S_PARM, "unstamped": no times.
 * Grey level of frame k, at row y: (k + y) mod 256; its time: the last whole period, monotonic. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { WIDTH = 64, HEIGHT = 48, BUFFERS = 4, SLOT = 65536, FAULT_AT = 40 };

static struct {
    int fd;
    unsigned format;
    unsigned rate;
    unsigned char *memory;
    int queue[BUFFERS];
    int queued;
    int streaming;
    long long first_us;
    unsigned next;
} camera = {-1, V4L2_PIX_FMT_YUYV, 30, NULL, {0}, 0, 0, 0, 0};

static long long now_us(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (long long)t.tv_sec * 1000000 + t.tv_nsec / 1000;
}

static int faulty(const char *kind)
{
    const char *fault = getenv("FAKE_V4L2_FAULT");
    return fault != NULL && strcmp(fault, kind) == 0;
}

static int is_ours(const char *path)
{
    const char *name = getenv("FAKE_V4L2");
    return name != NULL && strcmp(path, name) == 0;
}

static int open_camera(void)
{
    camera.fd = memfd_create("camera", 0);
    if (ftruncate(camera.fd, BUFFERS * SLOT) != 0)
        return -1;
    camera.memory = mmap(NULL, BUFFERS * SLOT, PROT_READ | PROT_WRITE, MAP_SHARED, camera.fd, 0);
    camera.queued = camera.streaming = 0;
    return camera.fd;
}

static int fail(int error)
{
    errno = error;
    return -1;
}

static void paint(int slot, unsigned number)
{
    unsigned step = camera.format == V4L2_PIX_FMT_YUYV ? 2 : 1;
    unsigned char *pixel = camera.memory + slot * SLOT;
    for (unsigned y = 0; y < HEIGHT; y++)
        for (unsigned x = 0; x < WIDTH; x++, pixel += step) {
            pixel[0] = (unsigned char)(number + y);
            if (step == 2)
                pixel[1] = 128;
        }
}

static int dequeue(struct v4l2_buffer *buffer)
{
    long long period_us = 1000000 / camera.rate;
    if (camera.queued == 0)
        return fail(EINVAL);
    while (faulty("stall") && camera.next >= FAULT_AT)
        usleep(10000);
    if (faulty("gone") && camera.next >= FAULT_AT)
        return fail(ENODEV);
    /* Whoever is later than the buffers last has lost frames. */
    long long newest = (now_us() - camera.first_us) / period_us;
    if (newest - camera.next > camera.queued)
        camera.next = (unsigned)(newest - camera.queued);
    if (faulty("drop") && camera.next % 10 == 5)
        camera.next++;
    if (faulty("slow") && camera.next % 2 == 1)
        camera.next++;
    long long at_us = camera.first_us + camera.next * period_us;
    while (now_us() < at_us)
        usleep((useconds_t)(at_us - now_us() > 0 ? at_us - now_us() : 0));
    int slot = camera.queue[0];
    memmove(camera.queue, camera.queue + 1, sizeof camera.queue - sizeof camera.queue[0]);
    camera.queued--;
    paint(slot, camera.next);
    buffer->index = (unsigned)slot;
    buffer->bytesused = WIDTH * HEIGHT * (camera.format == V4L2_PIX_FMT_YUYV ? 2 : 1);
    buffer->flags = V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC;
    buffer->sequence = camera.next++;
    if (faulty("unstamped"))
        at_us = 0;
    buffer->timestamp.tv_sec = at_us / 1000000;
    buffer->timestamp.tv_usec = at_us % 1000000;
    return 0;
}

static void fill(struct v4l2_format *format)
{
    unsigned wide = camera.format == V4L2_PIX_FMT_YUYV ? 2 : 1;
    format->fmt.pix.width = WIDTH;
    format->fmt.pix.height = HEIGHT;
    format->fmt.pix.pixelformat = camera.format;
    format->fmt.pix.field = V4L2_FIELD_NONE;
    format->fmt.pix.bytesperline = WIDTH * wide;
    format->fmt.pix.sizeimage = WIDTH * HEIGHT * wide;
}

static int answer(unsigned long request, void *data)
{
    switch (request) {
    case VIDIOC_QUERYCAP: {
        struct v4l2_capability *capability = data;
        memset(capability, 0, sizeof *capability);
        capability->capabilities = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        return 0;
    }
    case VIDIOC_G_INPUT:
        *(int *)data = 0;
        return 0;
    case VIDIOC_ENUMINPUT:
        memset(data, 0, sizeof(struct v4l2_input));
        return 0;
    case VIDIOC_S_FMT: {
        unsigned wanted = ((struct v4l2_format *)data)->fmt.pix.pixelformat;
        if (wanted == V4L2_PIX_FMT_YUYV || wanted == V4L2_PIX_FMT_GREY)
            camera.format = wanted;
        fill(data);
        return 0;
    }
    case VIDIOC_G_FMT:
        fill(data);
        return 0;
    case VIDIOC_S_PARM: {
        struct v4l2_fract *time = &((struct v4l2_streamparm *)data)->parm.capture.timeperframe;
        camera.rate = time->denominator > 60 * time->numerator ? 100 : 30;
    } /* fall through */
    case VIDIOC_G_PARM: {
        struct v4l2_captureparm *capture = &((struct v4l2_streamparm *)data)->parm.capture;
        capture->capability = V4L2_CAP_TIMEPERFRAME;
        capture->timeperframe.numerator = 1;
        capture->timeperframe.denominator = camera.rate;
        return 0;
    }
    case VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *wanted = data;
        if (wanted->count > BUFFERS)
            wanted->count = BUFFERS;
        return 0;
    }
    case VIDIOC_QUERYBUF: {
        struct v4l2_buffer *buffer = data;
        buffer->length = SLOT;
        buffer->m.offset = buffer->index * SLOT;
        return 0;
    }
    case VIDIOC_QBUF:
        camera.queue[camera.queued++] = (int)((struct v4l2_buffer *)data)->index;
        return 0;
    case VIDIOC_DQBUF:
        return dequeue(data);
    case VIDIOC_STREAMON:
        camera.first_us = now_us() + 1000000 / camera.rate;
        camera.next = 0;
        camera.streaming = 1;
        return 0;
    case VIDIOC_STREAMOFF:
        camera.streaming = camera.queued = 0;
        return 0;
    default:
        return fail(ENOTTY);
    }
}

int ioctl(int fd, unsigned long request, ...)
{
    va_list rest;
    va_start(rest, request);
    void *data = va_arg(rest, void *);
    va_end(rest);
    if (fd == camera.fd && fd >= 0)
        return answer(request, data);
    int (*real)(int, unsigned long, ...) =
        (int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl");
    return real(fd, request, data);
}

#define OPEN(NAME)                                                                                 \
    int NAME(const char *path, int flags, ...)                                                     \
    {                                                                                              \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        mode_t mode = (flags & (O_CREAT | O_TMPFILE)) != 0 ? va_arg(rest, mode_t) : 0;             \
        va_end(rest);                                                                              \
        if (is_ours(path))                                                                         \
            return open_camera();                                                                  \
        int (*real)(const char *, int, ...) =                                                      \
            (int (*)(const char *, int, ...))dlsym(RTLD_NEXT, #NAME);                              \
        return real(path, flags, mode);                                                            \
    }

OPEN(open)
OPEN(open64)
