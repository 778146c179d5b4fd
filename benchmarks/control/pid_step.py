"""One step of the PID controller, called from Python: `python -m benchmarks.control.pid_step`."""

from benchmarks.rows import Row, medians
from haselab import _core

STEPS = 500


def rows() -> list[Row]:
    pid = _core.Pid(0.85, 1.5, 0.15, 0.01, 0.02, -0.05, 0.1)

    def control() -> None:
        for k in range(STEPS):
            pid.step(0.01, 1e-5 * k)

    (control_s,) = medians(control)
    return [Row("PID step, from Python", control_s / STEPS * 1e6, "us")]


if __name__ == "__main__":
    for row in rows():
        print(row)
