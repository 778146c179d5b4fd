"""Feed-forward of a smoothed reference, and an integral of the error."""

from pathlib import Path

from haselab.controllers import ControllerKind, ControllerSetting, Measurement, Parameter


class MyController:
    """u = aim + integral; the aim follows the reference with a time constant."""

    def __init__(self, gain_per_s: float, smoothing_s: float) -> None:
        self.gain_per_s, self.smoothing_s = gain_per_s, smoothing_s

    def start(self, setting: ControllerSetting) -> None:
        """Reset the state for a new experiment."""
        self.setting = setting
        self.aim, self.integral = 0.0, setting.drive_start

    def step(self, reference: float, measurement: Measurement) -> float:
        """Return the next drive, in strain."""
        period_s = self.setting.period_s
        self.aim += period_s / (period_s + self.smoothing_s) * (reference - self.aim)
        if measurement.valid:
            more = self.gain_per_s * period_s * (self.aim - measurement.strain)
            drive = self.aim + self.integral + more
            if self.setting.drive_low < drive < self.setting.drive_high:  # no windup
                self.integral += more
        return self.aim + self.integral


KIND = ControllerKind(
    "mycontroller",
    MyController,
    parameters=(
        Parameter("gain_per_s", "1/s", default=1.0, low=0.0, high=20.0),
        Parameter("smoothing_s", "s", default=0.1, low=0.0, high=10.0),
    ),
    c_source=Path(__file__).with_name("mycontroller.c"),
)
