"""Check the operating system for `haselab doctor`: ports, cameras, network, real time, drivers.

Every check reads files below a root (`/proc`, `/sys`, `/etc`, `/dev`), which a test can replace.
A missing file gives no finding: a check reports only what it has read.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

from haselab.cli.doctor.machine import Finding, Machine, bad, good
from haselab.cli.doctor.network import examine_network
from haselab.rig.instruments.instrument import SystemNeeds

__all__ = ["examine_system"]

_RELOAD = "sudo udevadm control --reload && sudo udevadm trigger"
_RULES = "/etc/udev/rules.d/70-haselab.rules"
_CAP_SYS_NICE = 23  # capabilities(7)
_PRIORITY = 50  # of the guardian and of the fast loop
_NICE_LIMIT = 30  # getrlimit(2): 20 - niceness, for -10
_USBFS_MB = 200  # the default is 16; FLIR's application note on USBFS asks for 1000
_NI_VENDOR = "3923"
# Boards that NI's Linux driver does not know: nidaqmx-python issue 218 (USB-6003); its siblings and
# the USB-6008 family are inferred, since they have their own firmware.
_NO_LINUX = re.compile(r"\bUSB-600[012389]\b", re.IGNORECASE)
_SERVER = "a Windows computer with NI's gRPC device server, and daq.server"
_NI_LIBRARIES = (
    "usr/lib/x86_64-linux-gnu/libnidaqmx.so.1",
    "usr/lib64/libnidaqmx.so.1",
    "usr/lib/libnidaqmx.so.1",
)
# What ID_LIKE of os-release(5) may name; those like Debian take packages for Ubuntu (inferred).
_NI_LIKES = {"ubuntu": "Ubuntu", "debian": "Ubuntu", "rhel": "RHEL"}
_NI_SYSTEMS = ("ubuntu", "rhel", "rocky", "almalinux", "opensuse-leap")


def examine_system(machine: Machine, needs: SystemNeeds) -> list[Finding]:
    """Check what instruments and cameras need from the operating system.

    Args:
        machine: the computer.
        needs: of the rig; devices that are plugged in are always checked.
    Returns:
        Checks that failed, with advice to type, and checks that passed.
    """
    found = [*_ni_driver(machine, needs)]
    if machine.platform == "linux":
        found += _serial_ports(machine, needs)
        found += _usb_cameras(machine)
        if needs.genicam is not None and not needs.genicam.startswith("Fake"):
            found += examine_network(machine, needs.genicam, needs.frame_bytes)
        found += _real_time(machine)
    return found


# ---- NI's driver -------------------------------------------------------------------------------


def _ni_boards(machine: Machine) -> list[tuple[str, str]]:
    """Folder in sysfs and product of NI's USB devices."""
    folder = "sys/bus/usb/devices"
    return [
        (f"{folder}/{entry.name}", machine.word(f"{folder}/{entry.name}/product") or "USB device")
        for entry in machine.entries(folder)
        if machine.text(f"{folder}/{entry.name}/idVendor") == _NI_VENDOR
    ]


def _ni_driver(machine: Machine, needs: SystemNeeds) -> Iterator[Finding]:
    if machine.platform == "darwin":
        if needs.local_daq:
            yield bad("NI driver", "NI-DAQmx is not available for macOS", f"Use {_SERVER}")
        return
    if machine.platform != "linux":
        return
    boards = _ni_boards(machine)
    for folder, product in boards:
        if _NO_LINUX.search(product):
            yield bad("NI driver", f"{product} is not supported by NI-DAQmx for Linux",
                       f"Use {_SERVER}")  # fmt: skip
        elif machine.text(f"{folder}/power/control") == "auto":
            yield _suspends(product, folder)
    if not boards and not needs.local_daq:
        return
    if any((machine.root / path).exists() for path in _NI_LIBRARIES):
        modules = machine.text("proc/modules")
        if modules and "nikal " not in modules:
            yield bad("NI driver", "its kernel module nikal is not loaded",
                       "Type: sudo dkms autoinstall && sudo reboot")  # fmt: skip
        else:
            # Whether NI-DAQmx for Linux supports a USB board is decided by nilsdev.
            usb = f"; nilsdev must list {boards[0][1]}, else use {_SERVER}" if boards else ""
            yield good("NI driver", f"installed{usb}")
        return
    release = _release(machine)
    name = release.get("PRETTY_NAME", "this system")
    own, likes = release.get("ID", "ubuntu"), release.get("ID_LIKE", "").split()
    like = next((_NI_LIKES[each] for each in likes if each in _NI_LIKES), "")
    if own not in _NI_SYSTEMS and like:
        how = (
            f"NI has no packages for {name}, but has some for the related {like}: "
            f"try NI Linux Device Drivers for {like} from ni.com, or use {_SERVER}"
        )
    elif own in _NI_SYSTEMS:
        how = f"Install NI Linux Device Drivers for {name} from ni.com, or use {_SERVER}"
    else:
        how = f"NI has packages for Ubuntu, RHEL and openSUSE, but not for {name}: use {_SERVER}"
    yield bad("NI driver", "NI-DAQmx is not installed", how)


def _release(machine: Machine) -> dict[str, str]:
    pairs = (line.partition("=") for line in machine.text("etc/os-release").splitlines())
    return {key.strip(): value.strip().strip("\"'") for key, _, value in pairs}


def _suspends(product: str, folder: str) -> Finding:
    return bad("USB", f"{product} may be suspended while it is idle",
                f"Type: echo on | sudo tee /{folder}/power/control")  # fmt: skip


# ---- serial ports ------------------------------------------------------------------------------


def _serial_ports(machine: Machine, needs: SystemNeeds) -> Iterator[Finding]:
    plugged = [
        f"/dev/{entry.name}"
        for entry in machine.entries("dev")
        if entry.name.startswith(("ttyACM", "ttyUSB"))
    ]
    ports = sorted({*plugged, *(p for p in needs.serial_ports if p.startswith("/dev/"))})
    modem_manager = bool(ports) and machine.runs("ModemManager")
    for port in ports:
        path = port.lstrip("/")
        allowed = machine.may_use(path)
        if allowed is None:
            yield bad("serial port", f"{port} does not exist",
                       "Plug the device in, or change the port: ls /dev/ttyACM* "
                       "/dev/ttyUSB*")  # fmt: skip
            continue
        if not allowed:
            yield bad("serial port", f"{port}: permission denied for your user",
                       f"Type: sudo usermod -aG {machine.group(path)} $USER  then log in "
                      "again")  # fmt: skip
        elif modem_manager and not _ignored_by_modem_manager(machine, port):
            yield bad("serial port", f"ModemManager is running and may send AT commands to {port}",
                       _modem_advice(machine, port))  # fmt: skip
        else:
            yield good("serial port", port)


def _ignored_by_modem_manager(machine: Machine, port: str) -> bool:
    """Whether udev tells ModemManager to ignore a port (its documentation, "Modem filter")."""
    device = machine.text(f"sys/class/tty/{Path(port).name}/dev")
    marks = machine.text(f"run/udev/data/c{device}").splitlines() if device else []
    return any(mark in ("E:ID_MM_DEVICE_IGNORE=1", "E:ID_MM_PORT_IGNORE=1") for mark in marks)


def _modem_advice(machine: Machine, port: str) -> str:
    name = Path(port).name
    vendor = ""
    device = machine.root / f"sys/class/tty/{name}/device"
    for folder in (device.resolve(), device.resolve().parent):
        vendor = vendor or machine.text(str(folder / "idVendor"))
    which = f'ATTRS{{idVendor}}=="{vendor}"' if vendor else f'KERNEL=="{name}"'
    rule = f'SUBSYSTEM=="tty", {which}, ENV{{ID_MM_DEVICE_IGNORE}}="1"'
    return f"Type: echo '{rule}' | sudo tee -a {_RULES} && {_RELOAD}"


# ---- USB cameras -------------------------------------------------------------------------------


def _usb_cameras(machine: Machine) -> Iterator[Finding]:
    """Check USB3 Vision cameras: class ef, subclass 05, protocol 00 (aravis.rules of Aravis)."""
    folder = "sys/bus/usb/devices"
    cameras = {
        entry.name.partition(":")[0]
        for entry in machine.entries(folder)
        if [
            machine.text(f"{folder}/{entry.name}/bInterface{part}")
            for part in ("Class", "SubClass", "Protocol")
        ]
        == ["ef", "05", "00"]
    }
    for name in sorted(cameras):
        yield from _usb_camera(machine, f"{folder}/{name}")
    if cameras:
        yield from _usb_memory(machine)


def _usb_camera(machine: Machine, folder: str) -> Iterator[Finding]:
    product = machine.word(f"{folder}/product") or "USB3 Vision camera"
    bus, device = machine.number(f"{folder}/busnum"), machine.number(f"{folder}/devnum")
    if bus is not None and device is not None:
        path = f"dev/bus/usb/{bus:03d}/{device:03d}"
        if machine.may_use(path) is False:
            rule = 'SUBSYSTEM=="usb", ENV{ID_USB_INTERFACES}=="*:ef0500:*", MODE="0666"'
            yield bad("USB camera", f"{product}: permission denied for your user",
                       f"Type: echo '{rule}' | sudo tee -a {_RULES} && {_RELOAD}")  # fmt: skip
    speed = machine.number(f"{folder}/speed")
    if speed is not None and speed < 5000:
        yield bad("USB camera", f"{product} is connected at only {speed} Mbit/s (USB 2)",
                   "Use a USB 3 port and cable, without a hub")  # fmt: skip
    if machine.text(f"{folder}/power/control") == "auto":
        yield _suspends(product, folder)
    yield good("USB camera", product)


def _usb_memory(machine: Machine) -> Iterator[Finding]:
    path = "sys/module/usbcore/parameters/usbfs_memory_mb"
    size = machine.number(path)
    if size is not None and 0 < size < _USBFS_MB:  # 0: no limit
        yield bad("USB memory", f"usbfs_memory_mb is {size}: frames are lost at high rates",
                   f"Type: echo 1000 | sudo tee /{path}  (usbcore.usbfs_memory_mb=1000 on the "
                   "kernel's command line keeps it)")  # fmt: skip


# ---- real time ---------------------------------------------------------------------------------


def _real_time(machine: Machine) -> Iterator[Finding]:
    """Check the niceness and the real-time priority that the runtime and the guardian request."""
    status = machine.text("proc/self/status")
    limits = machine.text("proc/self/limits")
    if not status or not limits:
        return
    if _capable(status) or (
        _limit(limits, "Max realtime priority") >= _PRIORITY
        and _limit(limits, "Max nice priority") >= _NICE_LIMIT
    ):
        yield good("real time", "real-time priority is available")
        return
    yield bad(
        "real time", "real-time priority is not permitted",
        f"Type: printf '%s - rtprio {_PRIORITY}\\n%s - nice -10\\n' $USER $USER | sudo tee "
        "/etc/security/limits.d/90-haselab.conf  and log in again",
    )  # fmt: skip


def _capable(status: str) -> bool:
    for line in status.splitlines():
        if line.startswith("CapEff:"):
            try:
                return bool(int(line.split()[1], 16) >> _CAP_SYS_NICE & 1)
            except (IndexError, ValueError):
                return False
    return False


def _limit(limits: str, name: str) -> int:
    """Read a soft limit from /proc/self/limits."""
    for line in limits.splitlines():
        if line.startswith(name):
            words = line[len(name) :].split()
            if words[:1] == ["unlimited"]:
                return sys.maxsize
            return int(words[0]) if words and words[0].isdigit() else 0
    return 0
