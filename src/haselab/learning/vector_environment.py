"""Many loops as one Gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, shown
from haselab.learning.environment import action_space, actions_of, observation_space
from haselab.learning.simulation import StrainSimulation, whole_number

__all__ = ["StrainVectorEnv"]

Observed = NDArray[np.float32]
Flags = NDArray[np.bool_]


class StrainVectorEnv(VectorEnv[Observed, Observed, Any]):
    """`StrainEnv` many times over, stepped in one call of the compiled twin.

    An episode that has ended starts again in the next step, whose action it ignores and whose
    reward is 0 (`AutoresetMode.NEXT_STEP`).

    Args:
        num_envs: number of loops.
        task: `track`, `hold` or `gait`.
        options: see `StrainSimulation`.

    The information of a step has the arrays `strain` (true), `reference` (both as in its rewards)
    and `drive_v` (in V) of all loops, and for each a mask with an underscore before its name, which
    is always true.
    Raises:
        InputError: An argument is unknown or out of range.
    Example:
        >>> envs = StrainVectorEnv(4, "gait", devices=2)
        >>> observations, _ = envs.reset(seed=1)
        >>> envs.step(envs.action_space.sample())[0].shape
        (4, 6)
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 1, task: str = "track", **options: Any) -> None:
        if options.pop("render_mode", None) is not None:  # `make_vec` passes it on
            raise InputError(
                "The vector form shows no pictures. Leave out render_mode, or use StrainEnv."
            )
        self._simulation = StrainSimulation(task, num_envs, **options)
        self.num_envs = num_envs
        self.single_observation_space = observation_space()
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._all = np.ones(num_envs, dtype=bool)
        self._all.setflags(write=False)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Observed, JsonObject]:
        """Begin all episodes.

        Args:
            seed: of all loops together; several are combined, without those that are None.
            options: `reset_mask`, shape `(num_envs,)`: which episodes begin; default: all.
        Raises:
            InputError: A seed is not a whole number of 0 or more, or `reset_mask` has another type
                or shape.
        """
        if seed is not None:
            if isinstance(seed, np.ndarray):
                seed = seed.tolist()  # a number if the array has no dimension
            several = isinstance(seed, Sequence) and not isinstance(seed, str)
            parts = [part for part in seed if part is not None] if several else [seed]
            for part in parts:
                whole_number("The seed", part, 0, 2**63 - 1)
            # without any number, the operating system gives one
            self._np_random = np.random.default_rng((parts or None) if several else parts[0])
            self._np_random_seed = None if several else int(parts[0])
        if options is not None and not isinstance(options, Mapping):
            raise InputError(f"The options are {shown(options)}. State a table, or None.")
        which = self._chosen((options or {}).get("reset_mask"))
        self._simulation.reset(which.astype(np.int64), self.np_random)
        self._ended[which] = False
        return self._simulation.observe(), self._info()

    def _chosen(self, mask: object) -> NDArray[np.intp]:
        """Return the indices of the episodes that begin."""
        if mask is None:
            return np.arange(self.num_envs)
        flags = np.asarray(mask)
        if flags.dtype != np.bool_ or flags.shape != (self.num_envs,):
            raise InputError(
                f"reset_mask is {shown(mask)}. State {self.num_envs} values of True or False."
            )
        return np.flatnonzero(flags)

    def step(
        self, actions: Observed
    ) -> tuple[Observed, NDArray[np.float64], Flags, Flags, JsonObject]:
        """Let 10 ms pass in all loops, see `gymnasium.vector.VectorEnv.step`.

        Raises:
            InputError: The actions are not one finite number for each loop, or no episode has
                begun.
        """
        flat = actions_of(actions, self.num_envs)
        began = self._ended
        rewards, terminated, truncated = self._simulation.step(flat, self.np_random)
        if began.any():
            self._simulation.reset(np.flatnonzero(began).astype(np.int64), self.np_random)
            rewards[began], terminated[began], truncated[began] = 0.0, False, False
        self._ended = terminated | truncated
        return self._simulation.observe(), rewards, terminated, truncated, self._info()

    def __copy__(self) -> NoReturn:
        """Refuse copies, as `StrainSimulation` does.

        Raises:
            TypeError: always.
        """
        self._simulation.__reduce__()

    def _info(self) -> JsonObject:
        simulation = self._simulation
        found = {
            "strain": simulation.strain,
            "reference": simulation.rewarded_reference.copy(),
            "drive_v": simulation.drive_v.copy(),  # the next step changes it
        }
        return {**found, **{f"_{name}": self._all for name in found}}
