"""The common problem of `many_loops.py` in jax and in haselab, on one core; prints JSON."""

import json
import os

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.control.many_loops import (
    HIGH,
    LEVEL,
    LOW,
    PERIOD_S,
    SAMPLES,
    coefficients,
    ours,
    processor_s,
)

_UNROLL = 4  # the best of 1, 4 and 16


def run_loop(c):  # type: ignore[no-untyped-def]
    a11, a12, a21, a22, b1, b2, decay, push, kp, ki, kd, weight = c

    def step(carry, _):  # type: ignore[no-untyped-def]
        x1, x2, s, integral, filtered, error_sum, top, bottom, limited = carry
        y = x1 + s
        error = LEVEL - y
        change = weight * (y - filtered)
        direct = kp * error - kd * change
        free = direct + integral
        outward = ((free > HIGH) & (error > 0)) | ((free < LOW) & (error < 0))
        integral = jnp.where(outward, integral, integral + ki * error)
        u = jnp.clip(direct + integral, LOW, HIGH)
        kept = (
            error_sum + jnp.abs(error),
            jnp.maximum(top, y),
            jnp.minimum(bottom, y),
            limited + ((u >= HIGH) | (u <= LOW)),
        )
        after = a11 * x1 + a12 * x2 + b1 * u, a21 * x1 + a22 * x2 + b2 * u
        return (*after, decay * s + push * u, integral, filtered + change, *kept), None

    start = (*[jnp.float32(0)] * 6, -jnp.float32(jnp.inf), jnp.float32(jnp.inf), jnp.float32(0))
    last, _ = jax.lax.scan(step, start, None, length=SAMPLES, unroll=_UNROLL)
    return jnp.stack([last[5] * PERIOD_S, last[6], last[7], last[8] * PERIOD_S])


def main() -> None:
    c = jnp.asarray(coefficients().T, jnp.float32)
    compiled = jax.jit(jax.vmap(run_loop))
    jax_s, ours_s = processor_s(lambda: np.asarray(compiled(c)), ours(), rounds=5)
    print(json.dumps({"jax_s": jax_s, "ours_s": ours_s}))


if __name__ == "__main__":
    main()
