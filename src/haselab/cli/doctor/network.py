"""Check the network to a GigE Vision camera, for `haselab doctor`."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator

from haselab.cli.doctor.machine import Finding, Machine, bad, good

__all__ = ["examine_network"]

_FRAME_BYTES = 4 * 2**20  # of a camera whose frame size is not known
_JUMBO = 8192  # recommended by Aravis' documentation, "Ethernet Devices"


def examine_network(
    machine: Machine, name: str, frame_bytes: int | None = None
) -> Iterator[Finding]:
    """Check the socket buffers and the network port of a camera.

    Args:
        machine: the computer.
        name: of the camera, or its address; with a name only, its port is not known.
        frame_bytes: size of a frame; None: not known.
    Yields:
        What is wrong; else the port.
    """
    wanted = frame_bytes or _FRAME_BYTES
    most = machine.number("proc/sys/net/core/rmem_max")
    if most is not None and most < wanted:
        size = 1 << (4 * wanted - 1).bit_length()
        yield bad(
            "network", f"net.core.rmem_max is {most} bytes, but a frame of the camera has {wanted}",
            f"Type: echo net.core.rmem_max={size} | sudo tee /etc/sysctl.d/90-haselab.conf && "
            "sudo sysctl --system",
        )  # fmt: skip
    try:
        address = ipaddress.IPv4Address(name)
    except ValueError:
        return  # a name: its port is not known
    if address.is_loopback:
        return
    ports = _ports_of(machine, address)
    if not ports:
        yield bad("network", "no network port of this computer is in the camera's network "
                  f"({address})",
                  f"Type: sudo ip addr add {_neighbour(address)}/24 dev PORT  (ip link lists the "
                  "ports)")  # fmt: skip
        return
    yield from _port(machine, ports[0], shared=len(ports) > 1)


def _neighbour(address: ipaddress.IPv4Address) -> ipaddress.IPv4Address:
    """Another address of the same 24 bits."""
    last = int(address) & 0xFF
    return ipaddress.IPv4Address(int(address) - last + (1 if last != 1 else 2))


def _ports_of(machine: Machine, address: ipaddress.IPv4Address) -> list[str]:
    """Ports in the same network, the narrowest first, by /proc/net/route."""
    found: list[tuple[int, str]] = []
    for line in machine.text("proc/net/route").splitlines()[1:]:
        parts = line.split()
        try:
            target, gateway, mask = (_address(parts[k]) for k in (1, 2, 7))
        except (IndexError, ValueError):
            continue
        if gateway == 0 and mask and int(address) & mask == target:
            found.append((-mask.bit_count(), parts[0]))
    return [port for _, port in sorted(found)]


def _address(word: str) -> int:
    """A column of /proc/net/route: the bytes of an address, last one first."""
    return int.from_bytes(bytes.fromhex(word), "little")


def _port(machine: Machine, port: str, *, shared: bool) -> Iterator[Finding]:
    mtu = machine.number(f"sys/class/net/{port}/mtu")
    speed = machine.number(f"sys/class/net/{port}/speed")
    well = True
    if mtu is not None and mtu < _JUMBO:
        well = False
        yield bad("network", f"{port} carries packets of {mtu} bytes: the camera can use larger",
                   f"Type: sudo ip link set {port} mtu 9000")  # fmt: skip
    if speed is not None and 0 < speed < 1000:
        well = False
        yield bad("network", f"{port} is a link of {speed} Mbit/s, GigE Vision needs 1000",
                   "Use a cable of category 5e or better, and no old switch")  # fmt: skip
    strict = max(
        machine.number(f"proc/sys/net/ipv4/conf/{name}/rp_filter") or 0 for name in ("all", port)
    )
    if strict == 1 and shared:
        well = False
        yield bad("network", f"rp_filter is strict and {port} is not the only port in the "
                  "camera's network: frames may be dropped",
                   f"Type: sudo sysctl -w net.ipv4.conf.all.rp_filter=2 "
                   f"net.ipv4.conf.{port}.rp_filter=2")  # fmt: skip
    if machine.runs("firewalld"):
        well = False
        yield bad("network", f"firewalld is active and may block frames on {port}",
                   f"Type: sudo firewall-cmd --permanent --zone=trusted --change-interface={port} "
                   "&& sudo firewall-cmd --reload")  # fmt: skip
    elif "ENABLED=yes" in machine.text("etc/ufw/ufw.conf"):
        well = False
        yield bad("network", f"ufw is active and may block frames on {port}",
                   f"Type: sudo ufw allow in on {port} proto udp")  # fmt: skip
    if well:
        yield good("network", f"{port}, packets of {mtu or 'unknown'} bytes")
