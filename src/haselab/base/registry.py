"""One registry for every extension point: what haselab has, and what other packages add."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint
from typing import Generic, TypeVar, cast

from haselab.base.errors import HaselabError, InputError, described
from haselab.base.exits import no_exit

__all__ = ["Registry"]

T = TypeVar("T")


class Registry(Generic[T]):
    """Objects of one extension point by name: haselab's own, and entry points of other packages.

    haselab's own are listed in the code and not in its metadata, because an outdated installation
    must not lose them. A package is imported only when its object is requested.

    Args:
        what: a word for one of them, such as "controller".
        group: of the entry points.
        own: haselab's own, as `module:name`, by name.
        fault: returns what is wrong with an object under a name; empty: nothing.
        error: class of the errors.
    """

    def __init__(
        self,
        what: str,
        group: str,
        own: Mapping[str, str],
        fault: Callable[[object, str], str],
        error: type[HaselabError] = InputError,
    ) -> None:
        self.what, self.group = what, group
        self._fault, self._error = fault, error
        self._own = [EntryPoint(name, place, group) for name, place in own.items()]
        self.others = functools.cache(self._others)

    def _others(self) -> tuple[EntryPoint, ...]:
        found = importlib.metadata.entry_points(group=self.group)
        return tuple(sorted(found, key=lambda point: (point.name, point.value)))

    def packages(self) -> dict[str, str]:
        """Name of each object, haselab's own first, and its package; nothing is imported.

        Returns:
            The packages with their versions, `haselab` without, by the objects' names.
        """
        return {point.name: _package(point) for point in (*self._own, *self.others())}

    def find(self, name: str) -> T:
        """Find an object by its name; its package is imported now.

        Args:
            name: of the object.
        Returns:
            The object.
        Raises:
            HaselabError: Of the class `error`: the name is unknown or registered more than once,
                or the object does not load or has a fault.
        """
        found = [point for point in (*self._own, *self.others()) if point.name == name]
        if not found:
            raise self._error(
                f"No {self.what} {name!r} is registered. Use one of {', '.join(self.packages())}, "
                "or install the package that provides it."
            )
        packages = " and ".join(map(_package, found))
        if len(found) > 1:
            raise self._error(
                f"The {self.what} {name!r} is registered more than once, by {packages}. Uninstall "
                "all but one of these packages."
            )
        try:
            with no_exit():
                loaded = found[0].load()
                fault = self._fault(loaded, name)
        except Exception as error:  # another package may raise anything
            fault = f"it does not load ({described(error)})"
        if fault:
            raise self._error(
                f"The {self.what} {name!r} of package {packages} ({found[0].value}) cannot be "
                f"used: {fault}. Fix or uninstall the package."
            )
        return cast(T, loaded)

    def usable(self) -> dict[str, T]:
        """Load all objects, without those that `find` refuses.

        Returns:
            The objects by name.
        """
        found = {}
        for name in self.packages():
            with contextlib.suppress(self._error):
                found[name] = self.find(name)
        return found


def _package(point: EntryPoint) -> str:
    """Name and version of the package of an entry point; `haselab` for its own."""
    return "haselab" if point.dist is None else f"{point.dist.name} {point.dist.version}"
