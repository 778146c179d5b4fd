"""One loop as a Gymnasium environment."""

from __future__ import annotations

from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, shown
from haselab.learning.simulation import (
    LARGEST_OBSERVATION,
    OBSERVATIONS,
    StrainSimulation,
    whole_number,
)
from haselab.rig.twin.camera import TwinCamera
from haselab.scoreboard.devices import find_device

__all__ = ["StrainEnv", "action_space", "actions_of", "observation_space"]


def observation_space() -> spaces.Box[np.float32]:
    """What one policy sees, see `StrainSimulation.observe`."""
    return spaces.Box(-LARGEST_OBSERVATION, LARGEST_OBSERVATION, (len(OBSERVATIONS),), np.float32)


def action_space() -> spaces.Box[np.float32]:
    """The drive voltage, from the lowest (-1) to the highest (1)."""
    return spaces.Box(-1.0, 1.0, (1,), np.float32)


def actions_of(action: object, count: int) -> NDArray[np.float64]:
    """The actions as numbers, one for each loop.

    Args:
        action: of a policy.
        count: number of loops.
    Raises:
        InputError: They are not numbers, or not one for each loop.
    """
    found = np.asarray(action)
    # A single number may have any shape. Several in another shape, such as (2, 2), are a mistake.
    fits = found.size == count and (count == 1 or found.shape in [(count,), (count, 1)])
    if found.dtype.kind not in "iuf" or not fits:
        raise InputError(
            f"The action is {shown(action)}. State {count} "
            f"{'number' if count == 1 else 'numbers'} from -1 to 1."
        )
    return found.astype(np.float64).reshape(count)


class StrainEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A policy closes the loop on a planar HASEL by capacitive self-sensing, at 100 Hz.

    Each episode takes one of the drawn devices. The reward of an update is
    `-|strain - reference| / 0.05 - 0.05 change**2` with the true strain and the change of the
    action. It is -100, and the episode ends, if the device breaks down or leaves the lengths in
    which its physical model is valid. The information of a step has this `strain` and `reference`;
    the observation has the reference of the next update.

    Args:
        task: `track`, `hold` or `gait`.
        render_mode: None, or `rgb_array`: what the twin's camera sees.
        options: see `StrainSimulation`.
    Raises:
        InputError: An argument is unknown or out of range.
    Example:
        >>> env = StrainEnv("track", devices=2)
        >>> observation, info = env.reset(seed=1)
        >>> observation.shape
        (6,)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 100}  # noqa: RUF012

    def __init__(
        self, task: str = "track", *, render_mode: str | None = None, **options: Any
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"render_mode is {render_mode!r}. Use None or 'rgb_array'.")
        self._simulation = StrainSimulation(task, 1, **options)
        self.observation_space, self.action_space = observation_space(), action_space()
        self.render_mode = render_mode
        self._camera: TwinCamera | None = None
        self._frames = 0
        self._ended = False

    def reset(
        self, *, seed: int | None = None, options: JsonObject | None = None
    ) -> tuple[NDArray[np.float32], JsonObject]:
        """Begin an episode, see `gymnasium.Env.reset`.

        Args:
            seed: of this episode and the next ones; None: the random numbers continue.
            options: not used.
        Raises:
            InputError: The seed is not a whole number of 0 or more.
        """
        if seed is not None:
            whole_number("The seed", seed, 0, 2**63 - 1)
            seed = int(seed)  # Gymnasium refuses integers of numpy
        super().reset(seed=seed)
        self._simulation.reset(np.zeros(1, dtype=np.int64), self.np_random)
        self._ended = False
        return self._simulation.observe()[0], self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, JsonObject]:
        """Let 10 ms pass, see `gymnasium.Env.step`.

        Raises:
            InputError: The action is not one number, or the episode has not begun or is over.
        """
        if self._ended:
            raise InputError("The episode is over. Call reset() before step().")
        actions = actions_of(action, 1)
        rewards, terminated, truncated = self._simulation.step(actions, self.np_random)
        self._ended = bool(terminated[0] or truncated[0])
        return (
            self._simulation.observe()[0], float(rewards[0]), bool(terminated[0]),
            bool(truncated[0]), self._info(),
        )  # fmt: skip

    def render(self) -> NDArray[np.uint8] | None:
        """Frame of the camera, shape `(H, W, 3)`; None without a render mode.

        Raises:
            InputError: No episode has begun.
        """
        if self.render_mode is None:
            return None
        if not self._simulation.length_m.all():
            raise InputError("The episode has not begun. Call reset() before render().")
        if self._camera is None:
            config = find_device("hz").config
            law = config.law
            self._camera = TwinCamera(config.camera, 0.5 * law.width_m, law.free_length_m, 0)
        length_m = float(self._simulation.length_m[0])
        exposure = np.full((1, self._camera.exposure_times_s(np.zeros(1)).shape[1]), length_m)
        grey = self._camera.render(exposure, self._frames)[0]
        self._frames += 1
        return np.repeat(grey[:, :, None], 3, axis=2)

    def __copy__(self) -> NoReturn:
        """Refuse copies, as `StrainSimulation` does.

        Raises:
            TypeError: always.
        """
        self._simulation.__reduce__()

    def _info(self) -> JsonObject:
        simulation = self._simulation
        return {
            "strain": float(simulation.strain[0]),
            "reference": float(simulation.rewarded_reference[0]),
            "drive_v": float(simulation.drive_v[0]),
        }
