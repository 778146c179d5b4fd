"""Linking of particle detections to trajectories."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from haselab.base import InputError
from haselab.tracking.options import Floats

__all__ = ["Trajectories", "link_particles", "nearest_pairs"]


@dataclass(frozen=True)
class Trajectories:
    """Linked detections, one row each, in order of frames.

    Args:
        frame: frame of the detection. Shape `(N,)`.
        particle: index of its trajectory, from 0. Shape `(N,)`.
        x_px, y_px: position, in px. Shape `(N,)`.
    """

    frame: NDArray[np.intp]
    particle: NDArray[np.intp]
    x_px: Floats
    y_px: Floats


@dataclass
class _Live:
    """Trajectories that may continue."""

    place: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    velocity: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    number: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    missed: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))


def nearest_pairs(expected: Floats, found: Floats, reach_px: float) -> NDArray[np.intp]:
    """Assign detections to expected positions by least total squared distance; -1 for none.

    A pair costs its squared distance, an unassigned position `reach_px`²; clusters of positions
    that share a detection are solved exactly.
    """
    partner = np.full(len(expected), -1, np.intp)
    if not len(expected) or not len(found):
        return partner
    near = cKDTree(expected).sparse_distance_matrix(cKDTree(found), reach_px, output_type="ndarray")
    alone = (np.bincount(near["i"], minlength=len(expected))[near["i"]] == 1) & (
        np.bincount(near["j"], minlength=len(found))[near["j"]] == 1
    )
    partner[near["i"][alone]] = near["j"][alone]
    near = near[~alone]
    size = len(expected) + len(found)
    graph = coo_array((np.ones(len(near)), (near["i"], near["j"] + len(expected))), (size, size))
    cluster = connected_components(graph, directed=False)[1][near["i"]]
    for part in np.split(np.argsort(cluster, kind="stable"), _breaks(np.sort(cluster))):
        edges = near[part]
        rows, row = np.unique(edges["i"], return_inverse=True)
        columns, column = np.unique(edges["j"], return_inverse=True)
        cost = np.full((len(rows), len(columns) + len(rows)), reach_px**2)
        cost[:, : len(columns)] = 2.0 * len(rows) * reach_px**2
        cost[row, column] = edges["v"] ** 2
        chosen_row, chosen = linear_sum_assignment(cost)
        real = chosen < len(columns)
        partner[rows[chosen_row[real]]] = columns[chosen[real]]
    return partner


def _breaks(sorted_labels: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.flatnonzero(np.diff(sorted_labels)) + 1


def _advance(
    live: _Live, found: Floats, partner: NDArray[np.intp], memory: int, first_free: int
) -> tuple[_Live, NDArray[np.intp], int]:
    """Update the live trajectories; return them, each detection's particle, and the next index."""
    numbers = np.full(len(found), -1, np.intp)
    hit = partner >= 0
    numbers[partner[hit]] = live.number[hit]
    new = np.flatnonzero(numbers < 0)
    numbers[new] = first_free + np.arange(len(new))
    gone = ~hit & (live.missed < memory)
    gap = (live.missed[hit] + 1)[:, None]
    after = _Live(
        place=np.concatenate([found[partner[hit]], live.place[gone], found[new]]),
        velocity=np.concatenate(
            [
                (found[partner[hit]] - live.place[hit]) / gap,
                live.velocity[gone],
                np.zeros((len(new), 2)),
            ]
        ),
        number=np.concatenate([live.number[hit], live.number[gone], numbers[new]]),
        missed=np.concatenate(
            [np.zeros(int(hit.sum()), np.intp), live.missed[gone] + 1, np.zeros(len(new), np.intp)]
        ),
    )
    return after, numbers, first_free + len(new)


def link_particles(
    detections: Iterable[Floats], *, reach_px: float, memory: int = 3, persistence: float = 0.0
) -> Trajectories:
    """Link detections to trajectories, frame by frame.

    Each live trajectory expects its particle at its last position plus `persistence` times its last
    velocity; pairs minimise the sum of squared distances.

    Args:
        detections: centres `[x, y]` of each frame in turn, in px. Shape `(N, 2)` each.
        reach_px: largest distance of a particle from its expected position, in px.
        memory: frames that a particle may be missing.
        persistence: 0 for diffusing particles, 1 for particles of constant velocity.

    Returns:
        The trajectories, including single detections.

    Raises:
        InputError: `reach_px` is not positive, `memory` is negative, or `persistence` is not
            in [0, 1].

    Source: Crocker and Grier 1996.

    Example:
        >>> seen = [np.array([[0.0, 0.0], [9.0, 0.0]]), np.array([[9.4, 0.0], [0.3, 0.0]])]
        >>> link_particles(seen, reach_px=2.0).particle.tolist()
        [0, 1, 1, 0]
    """
    if not reach_px > 0.0 or memory < 0 or not 0.0 <= persistence <= 1.0:
        raise InputError(
            f"reach_px = {reach_px:g}, memory = {memory}, persistence = {persistence:g}; reach_px "
            "must be above 0, memory 0 or more, and persistence in [0, 1]."
        )
    live, free = _Live(), 0
    frames, particles, places = [], [], []
    for index, detected in enumerate(detections):
        found = np.asarray(detected, float).reshape(-1, 2)
        ahead = persistence * live.velocity * (live.missed + 1)[:, None]
        partner = nearest_pairs(live.place + ahead, found, reach_px)
        live, numbers, free = _advance(live, found, partner, memory, free)
        frames.append(np.full(len(found), index, np.intp))
        particles.append(numbers)
        places.append(found)
    none = np.zeros(0, np.intp)
    where = np.concatenate([*places, np.zeros((0, 2))])
    return Trajectories(
        frame=np.concatenate([*frames, none]),
        particle=np.concatenate([*particles, none]),
        x_px=where[:, 0],
        y_px=where[:, 1],
    )
