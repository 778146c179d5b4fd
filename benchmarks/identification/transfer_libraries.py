"""Other libraries' transfer-function fits, in their own environment (they need an older numpy).

    python benchmarks/identification/transfer_libraries.py RECORDS.npz

Prints one JSON line per library.

RECORDS.npz: `u` (N,), `y` (R, N), `rate_hz`, `start` (3,). Each library fits as many of
the R outputs as it can in its time, in turn with the fit by hand, so that the ratio of times is
valid on a busy machine.
"""

import contextlib
import io
import json
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

SECONDS = 12.0
THIN = 10


def by_hand(u, y, rate_hz, start):
    """Output error with scipy; the model is known and the start is good."""
    period_s = 1.0 / rate_hz

    def simulated(p):
        gain, omega, zeta = p
        damped = omega * np.sqrt(1.0 - zeta * zeta)
        decay = np.exp(-zeta * omega * period_s)
        cosine, sine = np.cos(damped * period_s), np.sin(damped * period_s)
        lean = zeta * omega / damped
        b1 = 1.0 - decay * (cosine + lean * sine)
        b2 = decay * decay + decay * (lean * sine - cosine)
        return gain * lfilter([0.0, b1, b2], [1.0, -2.0 * decay * cosine, decay * decay], u)

    found = least_squares(lambda p: simulated(p) - y, start, x_scale=start, method="lm")
    spread = 2.0 * found.cost / (y.size - 3)
    _ = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac) * spread))
    return found.x


def resonance(numerator, denominator, rate_hz):
    """Gain, natural frequency and damping of the complex pair of a discrete model."""
    poles = np.roots(denominator)
    pair = poles[np.abs(poles.imag) > 1e-9]
    s = np.log(pair[np.argmax(pair.imag)]) * rate_hz
    gain = np.sum(numerator) / np.sum(denominator)
    return np.array([gain, abs(s), -s.real / abs(s)])


def pysib_sm(u, y, rate_hz):
    import pysib

    _, model = pysib.sm(u, y, 2, 2, 1)
    return resonance(model["B"], model["F"], rate_hz)


def pysib_oe(u, y, rate_hz):
    import pysib

    _, model = pysib.oe(u, y, 2, 2, 1)
    return resonance(model["B"], model["F"], rate_hz)


def sippy(method, **orders):
    def fit(u, y, rate_hz):
        from sippy_unipi import system_identification

        model = system_identification(y, u, method, tsample=1.0 / rate_hz, **orders)
        if hasattr(model, "A"):
            poles = np.linalg.eigvals(model.A)
            gain = (
                model.C @ np.linalg.inv(np.eye(len(poles)) - model.A) @ model.B + model.D
            ).item()
            denominator = np.real(np.poly(poles))
            return resonance([gain * denominator.sum()], denominator, rate_hz)
        numerator, denominator = model.NUMERATOR, model.DENOMINATOR
        flat = [np.ravel(part[0] if isinstance(part, list) else part) for part in
                (numerator, denominator)]  # fmt: skip
        return resonance(flat[0], flat[1], rate_hz)

    return fit


def sysidentpy_els(u, y, rate_hz):
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    model = FROLS(
        order_selection=False, n_terms=4, ylag=2, xlag=2, basis_function=Polynomial(degree=1),
        estimator=LeastSquares(unbiased=True),
    )  # fmt: skip
    model.fit(X=u.reshape(-1, 1), y=y.reshape(-1, 1))
    codes = np.asarray(model.final_model).ravel()
    named = {int(c): value for c, value in zip(codes, model.theta.ravel(), strict=True)}
    denominator = [1.0, -named.get(1001, 0.0), -named.get(1002, 0.0)]
    return resonance([named.get(2001, 0.0), named.get(2002, 0.0)], denominator, rate_hz)


def control_era(u, y, rate_hz):
    import control

    markov = control.markov(y, u, 80)
    model, _ = control.eigensys_realization(
        np.asarray(markov).reshape(1, 1, -1), 2, dt=1.0 / rate_hz
    )
    poles = np.linalg.eigvals(model.A)
    gain = np.real(control.dcgain(model)).item()
    denominator = np.real(np.poly(poles))
    return resonance([gain * denominator.sum()], denominator, rate_hz)


def octave(records, most):
    """n4sid of Octave's control package on thinned records, in one process; None: not there."""
    if shutil.which("octave") is None:
        return None
    from scipy.io import loadmat, savemat

    script = """
pkg load control; load('{0}');
for k = 1:size(y, 1)
  try
    tic; m = n4sid(iddata(y(k,:)', u', 1/rate), 2, 'k', 'none'); found(k,4) = toc;
    p = pole(m); p = p(imag(p) > 0);
    if isempty(p), found(k,1:3) = NaN; continue, end
    s = log(p(1)) * rate; found(k,1:3) = [dcgain(m)(1), abs(s), -real(s)/abs(s)];
  catch
    found(k,1:4) = NaN;
  end
end
save('-v6', '{1}', 'found');
"""
    with tempfile.TemporaryDirectory() as folder:
        given, out = f"{folder}/in.mat", f"{folder}/out.mat"
        rate_hz = float(records["rate_hz"]) / THIN
        savemat(given, {"u": records["u"][::THIN], "y": records["y"][:most, ::THIN],
                        "rate": rate_hz})  # fmt: skip
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run(["octave", "-q", "--no-gui", "--eval", script.format(given, out)],
                           capture_output=True, timeout=120, check=False)  # fmt: skip
        if not Path(out).exists():
            return None
        return loadmat(out)["found"]


LIBRARIES = {
    "pysib sm": (pysib_sm, 1),
    "pysib oe, every 10th": (pysib_oe, THIN),
    "SIPPY OE, every 10th": (sippy("OE", OE_orders=[2, 2, 1]), THIN),
    "SIPPY PARSIM-K, every 10th": (sippy("PARSIM-K", SS_fixed_order=2), THIN),
    "SIPPY N4SID, every 10th": (sippy("N4SID", SS_fixed_order=2), THIN),
    "SysIdentPy ELS, every 10th": (sysidentpy_els, THIN),
    "python-control markov + ERA, every 10th": (control_era, THIN),
}


def timed(job):
    start = time.perf_counter()
    found = job()
    return found, time.perf_counter() - start


def run(fit, thin, records):
    u, rate_hz, start = records["u"], float(records["rate_hz"]), records["start"]
    found, ratios, message = [], [], ""
    until = time.perf_counter() + SECONDS
    for y in records["y"]:
        _, hand_s = timed(lambda y=y: by_hand(u, y, rate_hz, start))
        silent = io.StringIO()
        try:
            with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent):
                number, spent_s = timed(
                    lambda y=y: fit(u[::thin].copy(), y[::thin].copy(), rate_hz / thin)
                )
            ratios.append(spent_s / hand_s)
        except Exception as error:  # whatever a library raises counts as its failure
            number, message = np.full(3, np.nan), f"{type(error).__name__}: {error}"[:80]
        found.append([float(value) for value in number])
        if time.perf_counter() > until:
            break
    return {
        "found": found,
        "ratio": float(np.median(ratios)) if ratios else None,
        "message": message,
    }


def main():
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    records = np.load(sys.argv[1])
    hand = [
        timed(lambda y=y: by_hand(records["u"], y, float(records["rate_hz"]), records["start"]))
        for y in records["y"]
    ]
    hand_s = float(np.median([spent for _, spent in hand]))
    print(json.dumps({"library": "scipy least_squares by hand, model and start given",
                      "found": [list(map(float, x)) for x, _ in hand], "ratio": 1.0,
                      "message": f"{hand_s * 1e3:.2f} ms"}), flush=True)  # fmt: skip
    for name, (fit, thin) in LIBRARIES.items():
        print(json.dumps({"library": name, **run(fit, thin, records)}), flush=True)
    found = octave(records, 50)
    if found is None:
        print(json.dumps({"library": "Octave n4sid", "found": [], "ratio": None,
                          "message": "Octave with package control is not installed"}))  # fmt: skip
    else:
        ratio = float(np.nanmedian(found[:, 3]) / hand_s)
        print(json.dumps({"library": "Octave n4sid, every 10th", "found": found[:, :3].tolist(),
                          "ratio": ratio, "message": ""}))  # fmt: skip


if __name__ == "__main__":
    main()
