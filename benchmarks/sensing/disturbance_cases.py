"""Monitor records with a disturbance of known form: the cases of the sensing board.

A series R-C of 127 pF and 20 kohm under a carrier of 25 mV at 2 kHz, both monitors at 200 kHz with
1 mV rms of white noise and a 16-bit converter of +-10 V, 2.5 Mohm per ratio, unless a case says
otherwise. Everything that passes the actuator obeys I = C dV/dt; what only a monitor sees is added
to that monitor alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from haselab.sensing import LockinConfig

__all__ = ["CASES", "Case", "Scene"]

Floats = NDArray[np.float64]
Signal = Callable[["Scene", np.random.Generator, Floats], tuple[Floats, Floats]]
Shape = Callable[["Scene", np.random.Generator, Floats], Floats]
TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Scene:
    """The bench of a case."""

    capacitance_f: float = 127e-12
    resistance_ohm: float = 20e3
    v_peak_v: float = 0.025
    carrier_hz: float = 2000.0
    true_carrier: float = 1.0  # over the stated one
    rate_hz: float = 200e3
    block: int = 2000
    noise_v: float = 1e-3
    lsb_v: float = 20.0 / 2**16
    ohm_per_ratio: float = 2.5e6

    def impedance_ohm(self, hz: float) -> complex:
        return self.resistance_ohm + 1.0 / (1j * TURN * hz * self.capacitance_f)

    @property
    def i_peak_v(self) -> float:
        return self.v_peak_v * self.ohm_per_ratio / abs(self.impedance_ohm(self.carrier_hz))

    @property
    def per_slope(self) -> float:
        """Current monitor over dV/dt of the voltage monitor."""
        return self.ohm_per_ratio * self.capacitance_f

    @property
    def bound(self) -> float:
        """Relative standard deviation of C, Cramer-Rao, for a block without a disturbance."""
        variance = self.noise_v**2 + self.lsb_v**2 / 12.0
        z = self.impedance_ohm(self.carrier_hz)
        peaks = self.v_peak_v**-2 + self.i_peak_v**-2
        return float(np.sqrt(2.0 * variance / self.block * peaks) * abs(z) / abs(z.imag))

    def config(self) -> LockinConfig:
        """What `haselab sense` takes of a file of which nothing else is stated."""
        return LockinConfig(
            self.rate_hz, self.block, self.carrier_hz, 0.0, self.ohm_per_ratio,
            search_updates=True, min_amplitude_codes=1e-6, full_scale=10.0 * (1.0 - 0.5**11),
        )  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One disturbance.

    Args:
        name: of it.
        words: one of them is in the reason of a block that is refused.
        drive: what is added to both monitors.
        after: what a monitor does to its signal before the noise is added: voltage, current.
        late: the same after the noise.
        noise: in place of white noise on each, shape `(n, 2)`.
        capacitance: factor of C over time.
        envelope: factor of the carrier over time.
        scene: the bench.
    """

    name: str
    words: tuple[str, ...] = ()
    drive: Signal | None = None
    after: Callable[["Scene", Floats], Floats] | None = None
    late: Callable[["Scene", np.random.Generator, Floats], Floats] | None = None
    noise: Shape | None = None
    capacitance: Shape | None = None
    envelope: Shape | None = None
    scene: Scene = field(default_factory=Scene)

    def record(self, blocks: int, seed: int) -> tuple[Floats, Floats]:
        """Readings `(blocks, block, 2)` and the true mean capacitance of each block."""
        s, rng = self.scene, np.random.default_rng([seed, len(self.name), ord(self.name[-1])])
        t = np.arange(blocks * s.block) / s.rate_hz
        turn = TURN * s.carrier_hz * s.true_carrier * t + rng.uniform(0.0, TURN)
        rise = np.ones_like(t) if self.envelope is None else self.envelope(s, rng, t)
        c = np.ones_like(t) if self.capacitance is None else self.capacitance(s, rng, t)
        omega = TURN * s.carrier_hz * s.true_carrier
        z = s.resistance_ohm + 1.0 / (1j * omega * s.capacitance_f * c)
        wave = s.v_peak_v * rise * np.exp(1j * turn)
        pair = np.stack([wave.real, (wave * s.ohm_per_ratio / z).real], axis=1)
        if self.drive is not None:
            pair += np.stack(self.drive(s, rng, t), axis=1)
        if self.after is not None:
            pair = self.after(s, pair)
        if self.noise is None:
            pair += s.noise_v * rng.standard_normal(pair.shape)
        else:
            pair += self.noise(s, rng, t)
        if self.late is not None:
            pair = self.late(s, rng, pair)
        pair = np.round(pair / s.lsb_v) * s.lsb_v
        means = s.capacitance_f * c.reshape(blocks, s.block).mean(axis=1)
        return pair.reshape(blocks, s.block, 2), means


# ---- what is added to the drive -------------------------------------------------------------


def through(level: Callable[[Floats], Floats], slope: Callable[[Floats], Floats]) -> Signal:
    """A drive voltage and the current that it charges the actuator with."""
    return lambda s, rng, t: (level(t), s.per_slope * slope(t))


def sine(peak_v: float, hz: float) -> Signal:
    return through(
        lambda t: peak_v * np.sin(TURN * hz * t),
        lambda t: peak_v * TURN * hz * np.cos(TURN * hz * t),
    )


def triangle(peak_v: float, hz: float) -> Signal:
    return through(
        lambda t: peak_v * (2.0 * np.abs(2.0 * ((hz * t + 0.137) % 1.0) - 1.0) - 1.0),
        lambda t: 4.0 * peak_v * hz * np.sign(2.0 * ((hz * t + 0.137) % 1.0) - 1.0),
    )


def tones(v: dict[float, float], i: dict[float, float]) -> Signal:
    """Sines at unknown phases on each monitor, frequency to peak."""

    def both(s: Scene, rng: np.random.Generator, t: Floats) -> tuple[Floats, Floats]:
        def one(parts: dict[float, float]) -> Floats:
            total = np.zeros_like(t)
            for hz, peak in parts.items():
                total += peak * np.sin(TURN * hz * t + rng.uniform(0.0, TURN))
            return total

        return one(v), one(i)

    return both


def hum(peak_v: float, hz: float, harmonics: dict[int, float] | None = None) -> Signal:
    parts = {hz * n: peak_v * share for n, share in ({1: 1.0} | (harmonics or {})).items()}
    return tones(parts, parts)


def loaded(hz: float, peak_v: float) -> Signal:
    """A tone of the generator, which passes the actuator as the carrier does."""

    def both(s: Scene, rng: np.random.Generator, t: Floats) -> tuple[Floats, Floats]:
        wave = peak_v * np.exp(1j * (TURN * hz * t + rng.uniform(0.0, TURN)))
        return wave.real, (wave * s.ohm_per_ratio / s.impedance_ohm(hz)).real

    return both


def harmonics(shares: dict[int, float], *, loads: bool, current_only: bool = False) -> Signal:
    """Harmonics of the carrier as shares of it, through the actuator or on each monitor."""

    def both(s: Scene, rng: np.random.Generator, t: Floats) -> tuple[Floats, Floats]:
        v, i = np.zeros_like(t), np.zeros_like(t)
        for n, share in shares.items():
            if loads:
                dv, di = loaded(n * s.carrier_hz, share * s.v_peak_v)(s, rng, t)
            else:
                turn = TURN * n * s.carrier_hz * t
                dv = share * s.v_peak_v * np.sin(turn + rng.uniform(0.0, TURN))
                di = share * s.i_peak_v * np.sin(turn + rng.uniform(0.0, TURN))
            v, i = v + (0.0 if current_only else dv), i + di
        return v, i

    return both


def steps(height_v: float, tau_s: float, places: tuple[float, ...] | int) -> Signal:
    """Steps through a first-order amplifier, up and down in turn: at shares of each block, or so
    many anywhere in it."""

    def both(s: Scene, rng: np.random.Generator, t: Floats) -> tuple[Floats, Floats]:
        v, i = np.zeros_like(t), np.zeros_like(t)
        blocks, sign = t.size // s.block, 1.0
        for k in range(blocks):
            at = sorted(rng.uniform(0.0, 1.0, places)) if isinstance(places, int) else places
            for share in at:
                start_s = (k + share) * s.block / s.rate_hz
                j = int(np.ceil(start_s * s.rate_hz))
                stop = min(t.size, j + int(20.0 * tau_s * s.rate_hz) + 1)
                decay = np.exp(-(t[j:stop] - start_s) / tau_s)
                v[j:stop] += sign * height_v * (1.0 - decay)
                v[stop:] += sign * height_v
                i[j:stop] += sign * height_v * s.per_slope / tau_s * decay
                sign = -sign
        return v, i

    return both


Response = Callable[[Floats], tuple[Floats, Floats]]


def responses(height_v: float, of: Response) -> Signal:
    """Steps up and down in turn, one anywhere in each block, with any response of the amplifier."""

    def both(s: Scene, rng: np.random.Generator, t: Floats) -> tuple[Floats, Floats]:
        v, i = np.zeros_like(t), np.zeros_like(t)
        for k in range(t.size // s.block):
            start_s = (k + rng.uniform(0.0, 1.0)) * s.block / s.rate_hz
            j = int(np.ceil(start_s * s.rate_hz))
            stop, height = min(t.size, j + 20 * s.block), height_v * (-1.0) ** k
            level, slope = of(t[j:stop] - start_s)
            v[j:stop] += height * level
            v[stop:] += height
            i[j:stop] += height * s.per_slope * slope
        return v, i

    return both


def ringing(hz: float, quality: float) -> Response:
    """Step response of second order, and its slope."""
    omega = TURN * hz
    decay = omega / (2.0 * quality)
    damped = np.sqrt(omega**2 - decay**2)

    def of(t: Floats) -> tuple[Floats, Floats]:
        fall = np.exp(-decay * t)
        level = 1.0 - fall * (np.cos(damped * t) + decay / damped * np.sin(damped * t))
        return level, fall * omega**2 / damped * np.sin(damped * t)

    return of


def two_tails(share: float, fast_s: float, slow_s: float) -> Response:
    def of(t: Floats) -> tuple[Floats, Floats]:
        fast, slow = share * np.exp(-t / fast_s), (1.0 - share) * np.exp(-t / slow_s)
        return 1.0 - fast - slow, fast / fast_s + slow / slow_s

    return of


def limited(rise_s: float) -> Response:
    """An amplifier whose slope is limited."""
    return lambda t: (np.minimum(t / rise_s, 1.0), (t < rise_s) / rise_s)


def plus(*parts: Signal) -> Signal:
    def both(s: Scene, rng: np.random.Generator, t: Floats) -> tuple[Floats, Floats]:
        found = [part(s, rng, t) for part in parts]
        return sum(p[0] for p in found), sum(p[1] for p in found)  # type: ignore[return-value]

    return both


# ---- what the monitors do -------------------------------------------------------------------


def flat(channel: int, share: float, *, both_sides: bool = True):  # type: ignore[no-untyped-def]
    """A monitor that cannot go beyond a share of its carrier's peak."""

    def after(s: Scene, pair: Floats) -> Floats:
        limit = share * (s.v_peak_v, s.i_peak_v)[channel]
        pair = pair.copy()
        pair[:, channel] = np.clip(pair[:, channel], -limit if both_sides else -np.inf, limit)
        return pair

    return after


def soft(channel: int, scale: float):  # type: ignore[no-untyped-def]
    """A monitor that saturates softly; scale is the level of saturation over the carrier's peak."""

    def after(s: Scene, pair: Floats) -> Floats:
        limit = scale * (s.v_peak_v, s.i_peak_v)[channel]
        pair = pair.copy()
        pair[:, channel] = limit * np.tanh(pair[:, channel] / limit)
        return pair

    return after


def hard(channel: int, share: float):  # type: ignore[no-untyped-def]
    """A limiter behind the noise: readings pile up at the limit."""

    def late(s: Scene, rng: np.random.Generator, pair: Floats) -> Floats:
        return flat(channel, share)(s, pair)

    return late


def spikes(height_v: float, channel: int):  # type: ignore[no-untyped-def]
    """One reading of each block is off."""

    def late(s: Scene, rng: np.random.Generator, pair: Floats) -> Floats:
        for k in range(len(pair) // s.block):
            pair[k * s.block + rng.integers(s.block), channel] += height_v
        return pair

    return late


def stuck(s: Scene, rng: np.random.Generator, pair: Floats) -> Floats:
    """Both channels hold a value for a millisecond."""
    for k in range(len(pair) // s.block):
        at = k * s.block + int(rng.integers(s.block - 200))
        pair[at : at + 200] = pair[at]
    return pair


def lost(share: float, how: str, channel: int = 1):  # type: ignore[no-untyped-def]
    """A share of each block without a signal on one channel: "noise" alone, "stuck", or "half"."""

    def late(s: Scene, rng: np.random.Generator, pair: Floats) -> Floats:
        n = int(share * s.block)
        for k in range(len(pair) // s.block):
            at = k * s.block + int(rng.integers(s.block - n + 1))
            part = pair[at : at + n, channel]
            noise = s.noise_v * rng.standard_normal(n)
            pair[at : at + n, channel] = {"noise": noise, "stuck": part[0], "half": 0.5 * part}[how]
        return pair

    return late


def shaped(power: float) -> Shape:
    """Noise whose density falls as f^-power, 1 mV rms."""

    def noise(s: Scene, rng: np.random.Generator, t: Floats) -> Floats:
        spectrum = np.fft.rfft(rng.standard_normal((t.size, 2)), axis=0)
        f = np.maximum(np.fft.rfftfreq(t.size, 1 / s.rate_hz), 20.0)
        made = np.fft.irfft(spectrum * (f**-power)[:, np.newaxis], n=t.size, axis=0)
        return np.asarray(s.noise_v * made / made.std(axis=0))

    return noise


def together(share: float) -> Shape:
    """White noise of which a part is common to both monitors."""

    def noise(s: Scene, rng: np.random.Generator, t: Floats) -> Floats:
        common = rng.standard_normal((t.size, 1))
        own = rng.standard_normal((t.size, 2))
        return s.noise_v * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own)

    return noise


def burst(s: Scene, rng: np.random.Generator, t: Floats) -> Floats:
    """A fifth of the time the noise is four times as large."""
    loud = 1.0 + 3.0 * ((t * s.rate_hz / s.block * 1.0) % 1.0 < 0.2)
    return np.asarray(s.noise_v * loud[:, np.newaxis] * rng.standard_normal((t.size, 2)))


def wave_of(depth: float, hz: float) -> Shape:
    return lambda s, rng, t: 1.0 + depth * np.sin(TURN * hz * t + rng.uniform(0.0, TURN))


# ---- the cases ------------------------------------------------------------------------------

LOUD = Scene(v_peak_v=0.25)
FAST = Scene(carrier_hz=5000.0)
COARSE = Scene(lsb_v=0.01)

CASES = (
    Case("plain"),
    Case("sine drive 4 V, 10 Hz", drive=sine(4.0, 10.0)),
    Case("sine drive 4 V, 25 Hz", drive=sine(4.0, 25.0)),
    Case("sine drive 1 V, 80 Hz", drive=sine(1.0, 80.0)),
    Case("triangle drive 4 V, 20 Hz", drive=triangle(4.0, 20.0)),
    Case("hum 0.1 V, 50 Hz", ("hum",), drive=hum(0.1, 50.0)),
    Case("hum 0.1 V, 50 Hz, voltage only", ("hum",), drive=tones({50.0: 0.1}, {})),
    Case("hum 1 V, 50 Hz", ("hum",), drive=hum(1.0, 50.0)),
    Case("hum 1 V, 60 Hz, 5 kHz", ("hum",), drive=hum(1.0, 60.0), scene=FAST),
    Case("hum 5 V, 60 Hz, 5 kHz", ("hum",), drive=hum(5.0, 60.0), scene=FAST),
    Case(
        "hum 0.2 V with 3, 5, 7, 9, 11",
        ("hum",),
        drive=hum(0.2, 50.0, {3: 0.4, 5: 0.3, 7: 0.2, 9: 0.1, 11: 0.1}),
    ),
    Case("step 0.2 V, tau 0.5 ms, at 3 ms", ("step",), drive=steps(0.2, 5e-4, (0.3,))),
    Case("step 0.2 V, tau 0.5 ms, anywhere", ("step",), drive=steps(0.2, 5e-4, 1)),
    Case("step 0.2 V, tau 2 ms, anywhere", ("step",), drive=steps(0.2, 2e-3, 1)),
    Case("step 0.2 V, tau 0.1 ms, anywhere", ("step",), drive=steps(0.2, 1e-4, 1)),
    Case("step 0.2 V, tau 20 us, anywhere", ("step",), drive=steps(0.2, 2e-5, 1)),
    Case("two steps 0.2 V, tau 20 us", ("step",), drive=steps(0.2, 2e-5, (0.2, 0.65))),
    Case("two steps 0.2 V anywhere", ("step",), drive=steps(0.2, 2e-5, 2)),
    Case("two steps 0.2 V, tau 0.5 ms", ("step",), drive=steps(0.2, 5e-4, (0.2, 0.65))),
    Case("step and hum 0.1 V", ("step", "hum"), drive=plus(steps(0.05, 2e-5, 1), hum(0.1, 50.0))),
    Case("converter step 10 mV, 5 steps", ("step of the converter",), scene=COARSE),
    Case(
        "converter step 10 mV, 2.5 steps",
        ("step of the converter",),
        scene=replace(COARSE, v_peak_v=0.0125),
    ),
    Case(
        "converter step 3 mV, noise 0.3 mV",
        ("step of the converter",),
        scene=Scene(lsb_v=3e-3, noise_v=3e-4),
    ),
    Case("current flat at 80 %", ("flat",), after=flat(1, 0.8)),
    Case("current flat at 95 %", ("flat",), after=flat(1, 0.95)),
    Case("current flat at 80 %, one side", ("flat",), after=flat(1, 0.8, both_sides=False)),
    Case("voltage flat at 80 %, 0.25 V", ("flat",), after=flat(0, 0.8), scene=LOUD),
    Case("current limiter at 80 %", ("flat",), late=hard(1, 0.8)),
    Case("current saturates softly", ("flat", "saturates"), after=soft(1, 1.5)),
    Case("third harmonic 3 %, generator", drive=harmonics({3: 0.03}, loads=True)),
    Case("third harmonic 3 %, each monitor", drive=harmonics({3: 0.03}, loads=False)),
    Case("third harmonic 3 %, 0.25 V", drive=harmonics({3: 0.03}, loads=True), scene=LOUD),
    Case("harmonics 2, 3, 5", drive=harmonics({2: 0.02, 3: 0.03, 5: 0.01}, loads=True)),
    Case("amplitude modulation 20 %, 35 Hz", ("modulat",), envelope=wave_of(0.2, 35.0)),
    Case("amplitude modulation 20 %, 150 Hz", ("modulat",), envelope=wave_of(0.2, 150.0)),
    Case("second tone 10 mV, 2.37 kHz", ("tone",), drive=tones({2370.0: 0.01}, {2370.0: 0.03})),
    Case("second tone 5 mV, 2.12 kHz", ("tone",), drive=tones({2120.0: 0.005}, {})),
    Case("tone 50 mV, 31 kHz", ("tone",), drive=tones({31e3: 0.05}, {31e3: 0.05})),
    Case("tone 0.1 V, 730 Hz", ("tone",), drive=tones({730.0: 0.1}, {730.0: 0.1})),
    Case("second tone through the load", ("tone",), drive=loaded(2600.0, 0.01)),
    Case("one reading of 0.5 V off", ("spike",), late=spikes(0.5, 1)),
    Case("pink noise", noise=shaped(0.5)),
    Case("brown noise", noise=shaped(1.0)),
    Case("noise common to both, 70 %", noise=together(0.7)),
    Case("noise in bursts", noise=burst),
    Case("C swings by 5 %, 20 Hz", capacitance=wave_of(0.05, 20.0)),
    Case("carrier 0.05 % off", scene=Scene(true_carrier=1.0005)),
    Case("stuck for 1 ms", ("stuck", "modulat"), late=stuck),
    Case("step 0.2 V, rings at 1 kHz", ("step",), drive=responses(0.2, ringing(1000.0, 3.0))),
    Case("step 0.1 V, rings at 3 kHz", ("step",), drive=responses(0.1, ringing(3000.0, 10.0))),
    Case("step 50 mV, rings at 500 Hz", ("step",), drive=responses(0.05, ringing(500.0, 2.0))),
    Case(
        "step, tails of 0.3 and 3 ms", ("step",), drive=responses(0.2, two_tails(0.5, 3e-4, 3e-3))
    ),
    Case(
        "step, tails of 0.1 and 1.5 ms",
        ("step",),
        drive=responses(0.2, two_tails(0.7, 1e-4, 1.5e-3)),
    ),
    Case("step 0.2 V, rises in 2 ms", ("step", "slope"), drive=responses(0.2, limited(2e-3))),
    Case("step 2 V, rises in 1 ms", ("step", "slope"), drive=responses(2.0, limited(1e-3))),
    Case("current lost for 30 %", ("lost",), late=lost(0.3, "noise")),
    Case("current lost for 60 %", ("lost",), late=lost(0.6, "noise")),
    Case("current stuck for 30 %", ("stuck",), late=lost(0.3, "stuck")),
    Case("current stuck for 60 %", ("stuck",), late=lost(0.6, "stuck")),
    Case("current halved for 30 %", ("monitor at",), late=lost(0.3, "half")),
    Case("blue noise", noise=shaped(-0.5)),
    Case("hum 0.3 V, blocks of 2.5 ms", ("hum",), drive=hum(0.3, 50.0), scene=Scene(block=500)),
    Case("hum 0.3 V, 500 Hz", ("hum",), drive=hum(0.3, 50.0), scene=Scene(carrier_hz=500.0)),
)
