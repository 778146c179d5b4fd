/* Takes: the folder of an FMU's resources. Gives: instances, and their states. */
#include "fmu/instance.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint64_t hash_of(const unsigned char *bytes, size_t size)
{
    uint64_t hash = 0xcbf29ce484222325u;
    size_t k;
    for (k = 0; k < size; ++k) {
        hash = (hash ^ bytes[k]) * 0x100000001b3u;
    }
    return hash;
}

static char *read_whole(const char *path, size_t *size)
{
    FILE *file = fopen(path, "rb");
    char *bytes = NULL;
    long end = -1;
    if (file == NULL) {
        return NULL;
    }
    if (fseek(file, 0, SEEK_END) == 0) {
        end = ftell(file);
    }
    if (end > 0 && fseek(file, 0, SEEK_SET) == 0) {
        bytes = malloc((size_t)end);
    }
    if (bytes != NULL && fread(bytes, 1, (size_t)end, file) != (size_t)end) {
        free(bytes);
        bytes = NULL;
    }
    fclose(file);
    *size = (size_t)end;
    return bytes;
}

static size_t block_of(const fmu_bench *b) { return (size_t)b->about.block_samples; }

size_t fmu_memory_size(const fmu_bench *b)
{
    return sizeof(fmu_memory) + b->about.parameters * sizeof(double) +
           2 * block_of(b) * sizeof(float);
}

float *fmu_readings(const fmu_bench *b, fmu_memory *m)
{
    return (float *)(void *)(m->parameter + b->about.parameters);
}

static int load(fmu_bench *b, size_t size)
{
    const fmu_header *h = &b->about;
    size_t at = sizeof *h;
    if (size < at) {
        return 0;
    }
    memcpy(&b->about, b->file, at);
    if (memcmp(h->magic, "HASELFMU", 8) != 0 || h->version != 2u ||
        h->bytes_of_parameters != sizeof(twin_parameters) ||
        h->bytes_of_state != sizeof(twin_state) || h->block_samples < TWIN_SUB ||
        h->block_samples > 65520 || h->block_samples % TWIN_SUB != 0 || h->parameters > 1000u ||
        h->constants > 1000u ||
        size != at + h->parameters * sizeof(fmu_record) + h->constants * sizeof(double) +
                    sizeof(twin_parameters)) {
        return 0;
    }
    b->records = (const fmu_record *)(const void *)(b->file + at);
    at += h->parameters * sizeof(fmu_record);
    b->constants = (const double *)(const void *)(b->file + at);
    at += h->constants * sizeof(double);
    memcpy(&b->p, b->file + at, sizeof b->p);
    b->owner = hash_of((const unsigned char *)b->file, size);
    return 1;
}

fmu_bench *fmu_new(const char *folder, char *message, size_t room)
{
    const size_t length = strlen(folder);
    const char *slash = length > 0 && (folder[length - 1] == '/' || folder[length - 1] == '\\') ? "" : "/";
    char *path = malloc(length + 16);
    fmu_bench *b = calloc(1, sizeof *b);
    size_t size = 0;
    if (path == NULL || b == NULL) {
        free(path);
        free(b);
        snprintf(message, room, "No memory is left for the instance. Close other programs.");
        return NULL;
    }
    snprintf(path, length + 16, "%s%stwin.bin", folder, slash);
    b->file = read_whole(path, &size);
    if (b->file == NULL || !load(b, size)) {
        snprintf(message, room, "%.160s is missing or was made by another version of haselab. Export "
                 "the FMU again.", path);
        free(path);
        fmu_free(b);
        return NULL;
    }
    free(path);
    b->codes = malloc(2 * block_of(b) * sizeof *b->codes);
    b->lengths = malloc(block_of(b) / TWIN_SUB * sizeof *b->lengths);
    b->cosine = malloc(2 * block_of(b) * sizeof *b->cosine);
    b->now = calloc(1, fmu_memory_size(b));
    if (b->codes == NULL || b->lengths == NULL || b->cosine == NULL || b->now == NULL) {
        snprintf(message, room, "No memory is left for the instance. Close other programs.");
        fmu_free(b);
        return NULL;
    }
    b->sine = b->cosine + block_of(b);
    fmu_reset(b);
    return b;
}

void fmu_free(fmu_bench *b)
{
    if (b != NULL) {
        free(b->file);
        free(b->codes);
        free(b->lengths);
        free(b->cosine);
        free(b->now);
        free(b);
    }
}

const char *fmu_message(const fmu_bench *b) { return b->message; }

fmu_status fmu_fail(fmu_bench *b, const char *format, ...)
{
    va_list values;
    va_start(values, format);
    vsnprintf(b->message, sizeof b->message, format, values);
    va_end(values);
    return FMU_ERROR;
}

/* ---- states ---- */

fmu_status fmu_remember(fmu_bench *b, fmu_memory **memory)
{
    fmu_memory *kept = *memory != NULL ? *memory : malloc(fmu_memory_size(b));
    if (kept == NULL) {
        return fmu_fail(b, "No memory is left for a state. Free other states.");
    }
    memcpy(kept, b->now, fmu_memory_size(b));
    *memory = kept;
    return FMU_OK;
}

static int is_own(fmu_bench *b, const fmu_memory *memory)
{
    if (memory == NULL || memory->owner != b->owner) {
        fmu_fail(b, "The state is not of this FMU. Use a state that this FMU has returned.");
        return 0;
    }
    return 1;
}

fmu_status fmu_restore(fmu_bench *b, const fmu_memory *memory)
{
    if (!is_own(b, memory)) {
        return FMU_ERROR;
    }
    memcpy(b->now, memory, fmu_memory_size(b));
    fmu_apply(b);
    fmu_set_carrier(b);
    return FMU_OK;
}

fmu_status fmu_serialise(fmu_bench *b, const fmu_memory *memory, void *bytes, size_t size)
{
    if (!is_own(b, memory)) {
        return FMU_ERROR;
    }
    if (size != fmu_memory_size(b)) {
        return fmu_fail(b, "The buffer has %lu bytes, but a state has %lu. Allocate as many.",
                        (unsigned long)size, (unsigned long)fmu_memory_size(b));
    }
    memcpy(bytes, memory, size);
    return FMU_OK;
}

void fmu_forget(fmu_memory *memory) { free(memory); }

fmu_memory *fmu_memory_of(fmu_bench *b, const void *bytes, size_t size)
{
    fmu_memory *kept = size == fmu_memory_size(b) ? malloc(size) : NULL;
    if (kept != NULL) {
        memcpy(kept, bytes, size);
        if (kept->owner != b->owner) {
            free(kept);
            kept = NULL;
        }
    }
    if (kept == NULL) {
        fmu_fail(b, "These %lu bytes are not a state of this FMU. Use a state that this FMU has "
                    "returned.", (unsigned long)size);
    }
    return kept;
}
