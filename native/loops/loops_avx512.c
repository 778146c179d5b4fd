/* Groups of loops with AVX-512 F and DQ: a group is one register of floats. */
#include "loops/loops.h"
#include "loops/loops_noise.h"

#include <immintrin.h>

#define WIDTH 16
typedef __m512 vf;
typedef __m512d vd;
typedef __mmask16 vm;

#define OP static inline __attribute__((always_inline))

OP vd vd_load(const double *x) { return _mm512_load_pd(x); }
OP void vd_store(double *to, vd x) { _mm512_store_pd(to, x); }
OP vd vd_add(vd a, vd b) { return _mm512_add_pd(a, b); }
OP vd vd_mul(vd a, vd b) { return _mm512_mul_pd(a, b); }
OP vd vd_of_low(vf x) { return _mm512_cvtps_pd(_mm512_castps512_ps256(x)); }
OP vd vd_of_high(vf x) { return _mm512_cvtps_pd(_mm512_extractf32x8_ps(x, 1)); }
OP vf vf_of(vd low, vd high)
{
    return _mm512_insertf32x8(_mm512_castps256_ps512(_mm512_cvtpd_ps(low)), _mm512_cvtpd_ps(high),
                              1);
}

OP vf vf_set(float x) { return _mm512_set1_ps(x); }
OP vf vf_load(const float *x) { return _mm512_load_ps(x); }
OP void vf_store(float *to, vf x) { _mm512_storeu_ps(to, x); }
OP vf vf_add(vf a, vf b) { return _mm512_add_ps(a, b); }
OP vf vf_sub(vf a, vf b) { return _mm512_sub_ps(a, b); }
OP vf vf_mul(vf a, vf b) { return _mm512_mul_ps(a, b); }
OP vf vf_div(vf a, vf b) { return _mm512_div_ps(a, b); }
OP vf vf_size(vf x) { return _mm512_abs_ps(x); }
/* a where it is larger (smaller) than b, else b */
OP vf vf_larger(vf a, vf b) { return _mm512_max_ps(a, b); }
OP vf vf_smaller(vf a, vf b) { return _mm512_min_ps(a, b); }
OP vf vf_select(vm m, vf a, vf b) { return _mm512_mask_mov_ps(b, m, a); }
OP vm vm_above(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }
OP vm vm_reaches(vf a, vf b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
OP vm vm_number(vf x) { return _mm512_cmp_ps_mask(x, x, _CMP_ORD_Q); }
OP vm vm_or(vm a, vm b) { return _kor_mask16(a, b); }
OP vm vm_and(vm a, vm b) { return _kand_mask16(a, b); }
OP vm vm_and_not(vm a, vm b) { return _kandn_mask16(b, a); }

/* hs_limit() */
OP vf vf_limit(vf x, vf low, vf high)
{
    return _mm512_maskz_mov_ps(vm_number(x), vf_smaller(high, vf_larger(low, x)));
}

/* x[(from - back) & mask] */
OP vf vf_gather(const float *x, int32_t from, const int32_t *back, int32_t mask)
{
    const __m512i index = _mm512_and_epi32(
        _mm512_sub_epi32(_mm512_set1_epi32(from), _mm512_load_epi32(back)),
        _mm512_set1_epi32(mask));
    return _mm512_i32gather_ps(index, x, 4);
}

#include "loops/loops_body.h"

const struct loops_kernel loops_avx512 = {run_any, make_noise};
