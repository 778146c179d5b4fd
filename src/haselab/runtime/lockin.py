"""The sensing of a rig: its lock-in, and the reference study's own chain."""

from __future__ import annotations

from dataclasses import replace

from haselab.rig import RigDescription
from haselab.sensing import Lockin, LockinConfig, PaperChain

__all__ = ["BLANKING_S", "counted_s", "lockin_of", "printed_chain_of"]

BLANKING_S = 0.5e-3  # after an output update, until amplifier and monitors have settled


def lockin_of(rig: RigDescription, carrier_hz: float) -> Lockin:
    """Make the lock-in for a rig, which ignores each block until its output has settled.

    The samples before the update contain information too, but late: in a loop the delay matters
    more.
    """
    settled = rig.switch_in_block + round(BLANKING_S * rig.rate_hz)
    config = LockinConfig(
        rate_hz=rig.rate_hz,
        block_samples=rig.block_samples,
        carrier_hz=carrier_hz,
        skew_s=rig.skew_s,
        ohm_per_ratio=rig.i_monitor_v_per_a / rig.v_monitor_v_per_v,
        blank=(0, settled),
        full_scale=rig.top_code,
    )
    if (found := rig.calibration) is not None:
        volt_v, ampere_v = found.offsets_v
        config = replace(
            config,
            scale_s=complex(*found.scale_s),
            stray_s=complex(*found.stray_s),
            offsets=(volt_v / rig.volt_per_code, ampere_v / rig.volt_per_code),
        )
    return Lockin(config)


def counted_s(rig: RigDescription, carrier_hz: float) -> float:
    """Time that the lock-in of a rig fits: twice from the middle of the fit to the block's end."""
    last_s = (rig.block_samples - 1) / rig.rate_hz
    return 2.0 * (last_s - lockin_of(rig, carrier_hz).middle_s) + 1.0 / rig.rate_hz


def printed_chain_of(rig: RigDescription, carrier_hz: float) -> PaperChain:
    """Make the reference study's own chain for a rig, which uses all samples of a block."""
    return PaperChain(replace(lockin_of(rig, carrier_hz).config, blank=(0, 0)))
