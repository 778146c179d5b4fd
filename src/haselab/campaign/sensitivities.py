"""How results depend on drawn parameters: Sobol indices and rank correlations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.base import JsonObject
from haselab.campaign.definition import Campaign
from haselab.campaign.groups import LEAST_CASES, Group, number_of
from haselab.store.optional import library

__all__ = ["sensitivities", "unranked_of"]

Floats = NDArray[np.float64]
# Sample blocks that an interval of a Sobol index needs. Intervals from 8 or 16 blocks contained the
# known total indices of the Ishigami function in only 68 to 75 % of simulated campaigns; those from
# 64 blocks in 95 % or more.
_LEAST_BLOCKS = 64
_SEED = 1  # of resampling: the same rows give the same intervals


def sensitivities(
    campaign: Campaign, groups: Sequence[Group], names: Sequence[str], *, independent: bool
) -> Iterator[JsonObject]:
    """How each result depends on each parameter that is drawn.

    Args:
        campaign: of the groups.
        groups: of its cases.
        names: of the results.
        independent: the cases of a group are independent draws.
    Yields:
        Rank correlations; for a design `saltelli` with the Sobol indices, which have no sign.
    """
    unranked = unranked_of(campaign)
    paths = [one.path for one in campaign.distributions if one.path not in unranked]
    for name in names:
        for group in groups:
            if campaign.design.kind == "saltelli":
                found = _sobol_indices(group, name, paths) if _is_whole(campaign, groups) else []
                drawn = _without_mixed(group, len(paths))
                signed = _rank_correlations(drawn, name, paths, independent=False)
                ranks = {one["parameter"]: one for one in signed}
                found = [{**ranks.get(one["parameter"], {}), **one} for one in found]
            else:
                found = _rank_correlations(group, name, paths, independent=independent)
            for one in found:
                yield {"result": name, "group": group.label, **one}


def unranked_of(campaign: Campaign) -> list[str]:
    """Parameters that are drawn from values without ranks, because they are not numbers.

    Args:
        campaign: with them.
    """
    return [
        one.path for one in campaign.distributions
        if not all(isinstance(each, (int, float)) for each in one.numbers)
    ]  # fmt: skip


def _is_whole(campaign: Campaign, groups: Sequence[Group]) -> bool:
    """Whether each group is one sample of the design, which indices need."""
    return all(len(group.rows) == campaign.points for group in groups)


def _without_mixed(group: Group, count: int) -> Group:
    """The first and the last case of each block; the others mix the parameters of both."""
    size = count + 2
    rows = tuple(row for k, row in enumerate(group.rows) if k % size in (0, size - 1))
    return Group(group.label, rows)


def _sobol_indices(group: Group, name: str, paths: Sequence[str]) -> list[JsonObject]:
    """First-order and total indices by SALib, without sample blocks in which a case failed."""
    blocks = group.values(name).reshape(-1, len(paths) + 2)
    whole = _scaled(blocks[np.isfinite(blocks).all(axis=1)])
    if whole.shape[0] < LEAST_CASES or np.ptp(whole) == 0.0 or not np.var(whole) > 0.0:
        return []
    analyse = library("SALib.analyze.sobol", "campaign").analyze
    bounds = {"num_vars": len(paths), "names": list(paths), "bounds": [[0.0, 1.0]] * len(paths)}
    with np.errstate(divide="ignore", invalid="ignore"):  # a resample may have no variance
        found = analyse(
            bounds, whole.reshape(-1), calc_second_order=False, num_resamples=200, seed=_SEED
        )
    return [
        {
            "parameter": path, "method": "Sobol indices", "blocks": whole.shape[0],
            "blocks_left_out": blocks.shape[0] - whole.shape[0],
            "first": _around(found["S1"][k], found["S1_conf"][k], whole.shape[0]),
            "total": _around(found["ST"][k], found["ST_conf"][k], whole.shape[0]),
        }
        for k, path in enumerate(paths)
    ]  # fmt: skip


def _scaled(values: Floats) -> Floats:
    """Values over a power of two, so that their squares neither overflow nor vanish."""
    largest = float(np.abs(values).max(initial=0.0))
    return np.asarray(np.ldexp(values, -math.frexp(largest)[1]))


def _around(value: float, half: float, blocks: int) -> JsonObject:
    """A number with its interval, if there are enough blocks to trust it."""
    has_ends = blocks >= _LEAST_BLOCKS and math.isfinite(half)
    ends = [float(value - half), float(value + half)] if has_ends else None
    return {"value": float(value), "ci95": ends}


def _rank_correlations(
    group: Group, name: str, paths: Sequence[str], *, independent: bool
) -> list[JsonObject]:
    r"""Spearman's $\rho$ between each parameter and a result, with Fisher's interval.

    The standard error of $\mathrm{artanh}\,\rho$ is $\sqrt{(1 + \rho^2/2)/(n - 3)}$ (Bonett and
    Wright, 2000).
    """
    from scipy.stats import spearmanr  # slow to import

    values = group.values(name)
    good = ~np.isnan(values)  # infinite: not reached, which ranks above any number
    count = int(good.sum())
    if count < LEAST_CASES or np.unique(values[good]).size < 2:
        return []
    found: list[JsonObject] = []
    for path in paths:
        x = np.array([number_of(row.values[path]) for row in group.rows])[good]
        varies = np.unique(x).size > 1
        rho = float(spearmanr(x, values[good]).statistic) if varies else math.nan
        rho = float(np.clip(rho, -1.0, 1.0))  # it may be beyond by rounding
        middle = np.arctanh(np.clip(rho, -1.0 + 1e-12, 1.0 - 1e-12))
        half = 1.959964 * math.sqrt((1.0 + 0.5 * rho * rho) / (count - 3.0))
        low, high = np.tanh([middle - half, middle + half])
        ends = [min(float(low), rho), max(float(high), rho)]  # of ±1, too
        found.append({
            "parameter": path, "method": "rank correlation", "count": count,
            "without_value": values.size - count,
            "correlation": {
                "value": rho, "ci95": ends if independent and varies else None,
            },
        })  # fmt: skip
    return found
