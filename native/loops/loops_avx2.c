/* Groups of loops with AVX2: a group is two registers of floats. */
#include "loops/loops.h"
#include "loops/loops_noise.h"

#include <immintrin.h>

#define WIDTH 8
typedef __m256 vf;
typedef __m256d vd;
typedef __m256 vm;

#define OP static inline __attribute__((always_inline))

OP vd vd_load(const double *x) { return _mm256_load_pd(x); }
OP void vd_store(double *to, vd x) { _mm256_store_pd(to, x); }
OP vd vd_add(vd a, vd b) { return _mm256_add_pd(a, b); }
OP vd vd_mul(vd a, vd b) { return _mm256_mul_pd(a, b); }
OP vd vd_of_low(vf x) { return _mm256_cvtps_pd(_mm256_castps256_ps128(x)); }
OP vd vd_of_high(vf x) { return _mm256_cvtps_pd(_mm256_extractf128_ps(x, 1)); }
OP vf vf_of(vd low, vd high) { return _mm256_set_m128(_mm256_cvtpd_ps(high), _mm256_cvtpd_ps(low)); }

OP vf vf_set(float x) { return _mm256_set1_ps(x); }
OP vf vf_load(const float *x) { return _mm256_load_ps(x); }
OP void vf_store(float *to, vf x) { _mm256_storeu_ps(to, x); }
OP vf vf_add(vf a, vf b) { return _mm256_add_ps(a, b); }
OP vf vf_sub(vf a, vf b) { return _mm256_sub_ps(a, b); }
OP vf vf_mul(vf a, vf b) { return _mm256_mul_ps(a, b); }
OP vf vf_div(vf a, vf b) { return _mm256_div_ps(a, b); }
OP vf vf_size(vf x) { return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), x); }
/* a where it is larger (smaller) than b, else b */
OP vf vf_larger(vf a, vf b) { return _mm256_max_ps(a, b); }
OP vf vf_smaller(vf a, vf b) { return _mm256_min_ps(a, b); }
OP vf vf_select(vm m, vf a, vf b) { return _mm256_blendv_ps(b, a, m); }
OP vm vm_above(vf a, vf b) { return _mm256_cmp_ps(a, b, _CMP_GT_OQ); }
OP vm vm_reaches(vf a, vf b) { return _mm256_cmp_ps(a, b, _CMP_GE_OQ); }
OP vm vm_number(vf x) { return _mm256_cmp_ps(x, x, _CMP_ORD_Q); }
OP vm vm_or(vm a, vm b) { return _mm256_or_ps(a, b); }
OP vm vm_and(vm a, vm b) { return _mm256_and_ps(a, b); }
OP vm vm_and_not(vm a, vm b) { return _mm256_andnot_ps(b, a); }

/* hs_limit() */
OP vf vf_limit(vf x, vf low, vf high)
{
    return _mm256_and_ps(vm_number(x), vf_smaller(high, vf_larger(low, x)));
}

/* x[(from - back) & mask] */
OP vf vf_gather(const float *x, int32_t from, const int32_t *back, int32_t mask)
{
    const __m256i behind = _mm256_load_si256((const __m256i *)(const void *)back);
    const __m256i index = _mm256_and_si256(_mm256_sub_epi32(_mm256_set1_epi32(from), behind),
                                           _mm256_set1_epi32(mask));
    return _mm256_i32gather_ps(x, index, 4);
}

#include "loops/loops_body.h"

const struct loops_kernel loops_avx2 = {run_any, make_noise};
