"""`haselab twin new`: write a commented TWIN.toml for one kind of actuator."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
from pydantic import BaseModel

from haselab.actuators import ACTUATORS, ActuatorLaw, CurlingHasel, PlanarHasel
from haselab.base import InputError
from haselab.cli.common import answer_options
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.rig.protocols import PLANAR_HASEL
from haselab.rig.twin.config import TwinConfig
from haselab.store.folder import write_new
from haselab.store.text_file import parse_toml
from haselab.store.toml import validated

__all__ = ["new"]

_ALONG_PX, _ACROSS_PX = 320.0, 400.0  # of the actuator at rest, of 512 rows and columns


@click.command("new")
@shared_option(
    "--kind", default=PLANAR_HASEL, show_default=True, metavar="KIND",
    detail="An unknown kind prints the known ones.",
)  # fmt: skip
@click.option("--name", default="my twin", show_default=True, help="Set the name of the bench.")
@click.option(
    "--set",
    "values",
    multiple=True,
    metavar="KEY=VALUE",
    help="Set one value, for example --set shell.length_m=0.08. Repeat the option for "
    "more. Default: those of the kind.",
)
@answer_options(OutputRule("late"), "It is a TWIN.toml. Default: print it.")
def new(kind: str, name: str, values: tuple[str, ...], as_json: bool, out: Path | None) -> None:
    """Write a TWIN.toml, which describes a simulated bench.

    The file contains every parameter of the actuator with its unit and limits. The sections
    amplifier, acquisition and camera are left out where they have the values of the reference
    study. For another kind than planar-hasel, the camera is scaled to the actuator.
    """
    data = _data(kind, name, values)
    config = validated(TwinConfig, data, "--set")
    if kind != PLANAR_HASEL:
        data["camera"] = _camera(config.law) | data.get("camera", {})
        config = validated(TwinConfig, data, "--set")
    text = "\n".join(_lines(config)) + "\n"
    if out is not None:
        write_new(out, text)
    if as_json:
        click.echo(json.dumps(config.model_dump(mode="json"), indent=2))
    elif out is None:
        click.echo(text, nl=False)


def _data(kind: str, name: str, values: Sequence[str]) -> dict[str, Any]:
    """Tables of TWIN.toml from the options."""
    data: dict[str, Any] = {"name": name, "kind": kind}
    if kind != PLANAR_HASEL:
        law = ACTUATORS.find(kind)
        data["actuator"] = {about.name: getattr(law, about.name) for about in law.described()}
    for given in values:
        key, equals, value = given.partition("=")
        section, dot, entry = key.strip().partition(".")
        try:
            parsed = parse_toml(f"value = {value}")["value"]
        except ValueError:
            parsed = None
        if not (equals and dot and section and entry) or parsed is None:
            raise InputError(
                f"--set {given} is not SECTION.KEY=VALUE. Use a key such as shell.length_m or "
                "actuator.cells, and a number or a list of numbers as the value."
            )
        table = data.setdefault(section, {})
        if not isinstance(table, dict):
            raise InputError(f"--set {given}: {section} is not a section. Use --{section}.")
        table[entry] = parsed
    return data


def _camera(law: ActuatorLaw) -> dict[str, Any]:
    """A camera that sees the whole actuator, which does not neck as a stretched shell does."""
    scale = max(law.free_length_m / _ALONG_PX, law.width_m / _ACROSS_PX)
    look = {"particle_stretch": 1.0, "neck_coefficient": 0.0}
    if isinstance(law, CurlingHasel):  # the camera sees the heights of clamp and tip
        look["particles"] = 0
    return {"scale_m_per_px": float(f"{scale:.2g}"), **look}


def _lines(config: TwinConfig) -> Iterator[str]:
    law = PlanarHasel if config.kind == PLANAR_HASEL else ACTUATORS.find(config.kind)
    yield '# A simulated bench. Use it in a rig file: kind = "twin", twin = "THIS FILE".'
    yield f"name = {json.dumps(config.name)}"
    yield f"kind = {json.dumps(config.kind)}"
    section = ""
    described = list(law.described())
    tables = list(dict.fromkeys(about.key.partition(".")[0] for about in described))
    for about in sorted(described, key=lambda one: tables.index(one.key.partition(".")[0])):
        table, _, entry = about.key.partition(".")
        if table != section:
            section = table
            yield f"\n[{section}]"
        value = json.dumps(_law_value(config, section, entry))
        unit = f"{about.unit}, " if about.unit else ""
        yield f"{entry} = {value}  # {unit}{about.low:g} to {about.high:g}: {about.description}"
    for name in ("load", "amplifier", "acquisition", "camera"):
        table_of: BaseModel = getattr(config, name)
        if name == "load" or table_of != type(table_of)():
            yield from _section(name, table_of)


def _section(name: str, table: BaseModel) -> Iterator[str]:
    yield f"\n[{name}]"
    for entry, about in type(table).model_fields.items():
        comment = f"  # {about.description}" if about.description else ""
        yield f"{entry} = {json.dumps(getattr(table, entry))}{comment}"


def _law_value(config: TwinConfig, section: str, entry: str) -> float | Sequence[float]:
    """A parameter of the actuator, from the table that holds it."""
    table = getattr(config, section)
    value: float | Sequence[float] = (
        table[entry] if isinstance(table, dict) else getattr(table, entry)
    )
    return value
