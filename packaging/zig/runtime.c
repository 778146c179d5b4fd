/* Functions of a compiler's run-time library that haselab needs, in place of those of `zig cc`.
 *
 * The library of zig contains exp, log, sin, cos and tan too. They would replace those of the system's
 * libm and give other bits than a build from source, so the wheels are linked without it.
 */
#include <complex.h>

#define HIDDEN __attribute__((visibility("hidden")))

/* Called when both parts of a complex product are NaN. */
double complex __muldc3(double a, double b, double c, double d);
HIDDEN double complex __muldc3(double a, double b, double c, double d)
{
    double complex out;
    double *const parts = (double *)&out;
    parts[0] = a * c - b * d;
    parts[1] = a * d + b * c;
    return out;
}

#ifdef __x86_64__
/* The features of the processor. `__builtin_cpu_supports` and `target_clones` of GCC and Clang read these two variables. The
 * library of `zig cc` sets no bit in them, so every choice would be the slowest one. The layout
 * and the bit numbers are those of libgcc and compiler-rt. Only the bits that haselab reads
 * are set.
 */
#include <cpuid.h>

enum { AVX2 = 10, AVX512F = 15, AVX512VL = 20, AVX512BW = 21, AVX512DQ = 22, LEVEL_4 = 98 - 32 };
enum { READY = 1U }; /* as the vendor: the variables are set */

extern struct model {
    unsigned int vendor, type, subtype, features;
} __cpu_model;
extern unsigned int __cpu_features2[4];
int __cpu_indicator_init(void);

HIDDEN struct model __cpu_model;
HIDDEN unsigned int __cpu_features2[4];

/* Registers that the operating system saves when it changes threads. */
static unsigned int saved_registers(void)
{
    unsigned int low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return low;
}

HIDDEN int __cpu_indicator_init(void)
{
    const unsigned int ymm = 0x06, zmm = 0xe6;
    unsigned int a, b, c, d, first_c, saved;
    if (__cpu_model.vendor) {
        return 0;
    }
    __cpu_model.vendor = READY;
    if (__get_cpuid_max(0, 0) < 7) {
        return 0;
    }
    __cpuid(1, a, b, first_c, d);
    saved = first_c & bit_OSXSAVE ? saved_registers() : 0;
    __cpuid_count(7, 0, a, b, c, d);
    if ((saved & ymm) == ymm && (first_c & bit_AVX) && (b & bit_AVX2)) {
        const unsigned int fused = first_c & bit_FMA && b & bit_BMI && b & bit_BMI2;
        __cpu_model.features |= 1U << AVX2;
        if ((saved & zmm) == zmm && (b & bit_AVX512F)) {
            const unsigned int parts = bit_AVX512VL | bit_AVX512BW | bit_AVX512DQ | bit_AVX512CD;
            __cpu_model.features |= 1U << AVX512F;
            __cpu_model.features |= b & bit_AVX512VL ? 1U << AVX512VL : 0;
            __cpu_model.features |= b & bit_AVX512BW ? 1U << AVX512BW : 0;
            __cpu_model.features |= b & bit_AVX512DQ ? 1U << AVX512DQ : 0;
            if (fused && (b & parts) == parts) {
                __cpu_features2[LEVEL_4 / 32] |= 1U << LEVEL_4 % 32;
            }
        }
    }
    return 0;
}

/* Runs before the constructors that read these variables. */
__attribute__((constructor(101))) static void at_start(void) { (void)__cpu_indicator_init(); }
#endif
