"""The doctor's look at an operating system: good and bad ones, planted in a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from haselab.cli.doctor.machine import Finding, Machine
from haselab.cli.doctor.system import examine_system
from haselab.rig.instruments.instrument import SystemNeeds

STATUS = "Name:\tpython\nCapEff:\t{}\n"
LIMITS = (
    "Limit                     Soft Limit           Hard Limit           Units\n"
    "Max nice priority         {1}                   {1}\n"
    "Max realtime priority     {0}                   {0}\n"
)
ROUTES = "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\tMTU\tWindow\tIRTT\n"
HERE = "eth1\t0001A8C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0\n"  # 192.168.1.0/24
OUT = "eth0\t00000000\t0100000A\t0003\t0\t0\t0\t00000000\t0\t0\t0\n"  # by 10.0.0.1
CAMERA = "sys/bus/usb/devices/2-1"
BOARD = "sys/bus/usb/devices/1-2"
HEALTHY: dict[str, str] = {
    "proc/self/status": STATUS.format("0000000000800000"),
    "proc/self/limits": LIMITS.format(0, 0),
    "proc/net/route": ROUTES + HERE + OUT,
    "proc/sys/net/core/rmem_max": "33554432",
    "proc/sys/net/ipv4/conf/all/rp_filter": "2",
    "sys/class/net/eth1/mtu": "9000",
    "sys/class/net/eth1/speed": "1000",
    "sys/module/usbcore/parameters/usbfs_memory_mb": "1000",
    f"{CAMERA}/product": "BFS-U3-13Y3M",
    f"{CAMERA}/speed": "5000",
    f"{CAMERA}/busnum": "2",
    f"{CAMERA}/devnum": "4",
    f"{CAMERA}/power/control": "on",
    f"{CAMERA}:1.0/bInterfaceClass": "ef",
    f"{CAMERA}:1.0/bInterfaceSubClass": "05",
    f"{CAMERA}:1.0/bInterfaceProtocol": "00",
    "dev/bus/usb/002/004": "",
    f"{BOARD}/idVendor": "3923",
    f"{BOARD}/product": "USB-6212",
    f"{BOARD}/power/control": "on",
    "usr/lib/x86_64-linux-gnu/libnidaqmx.so.1": "",
    "proc/modules": "nikal 122880 3 - Live 0x0\n",
    "etc/os-release": 'ID=ubuntu\nPRETTY_NAME="Ubuntu 22.04"\n',
    "dev/ttyACM0": "",
    "sys/class/tty/ttyACM0/dev": "166:0",
    "run/udev/data/c166:0": "E:ID_MM_CANDIDATE=1\nE:ID_MM_DEVICE_IGNORE=1\n",
    "proc/77/comm": "ModemManager",
}
NEEDS = SystemNeeds(
    serial_ports=("/dev/ttyACM0",), local_daq=True, genicam="192.168.1.7", frame_bytes=512 * 512
)
Plant = Callable[..., Machine]


@pytest.fixture
def plant(tmp_path: Path) -> Plant:
    """The healthy computer with other files; None takes one away."""

    def machine(
        changed: dict[str, str | None] | None = None, *, user: int = 12345, mode: int = 0o666
    ) -> Machine:
        for path, text in (HEALTHY | (changed or {})).items():
            if text is None:
                continue
            (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / path).write_text(text)
            if path.startswith("dev/"):
                (tmp_path / path).chmod(mode)
        return Machine(tmp_path, "linux", user, frozenset())

    return machine


def bad(machine: Machine, needs: SystemNeeds = NEEDS) -> list[Finding]:
    return [found for found in examine_system(machine, needs) if not found.found]


def test_a_healthy_computer_gets_no_advice_and_names_what_was_looked_at(plant):
    found = examine_system(plant(), NEEDS)
    assert [f for f in found if not f.found] == []
    assert [f.name for f in found] == [
        "NI driver",
        "serial port",
        "USB camera",
        "network",
        "real time",
    ]
    assert all(not f.advice for f in found)


def test_a_computer_of_which_nothing_can_be_read_gets_no_advice(tmp_path):
    for platform in ("linux", "win32", "darwin"):
        assert examine_system(Machine(tmp_path, platform, 1, frozenset()), SystemNeeds()) == []


@pytest.mark.parametrize(
    ("changed", "detail", "advice"),
    [
        (
            {"run/udev/data/c166:0": "E:ID_MM_CANDIDATE=1\n"},
            "ModemManager is running and may send AT commands to /dev/ttyACM0",
            'KERNEL=="ttyACM0", ENV{ID_MM_DEVICE_IGNORE}="1"\' | sudo tee -a /etc/udev/rules.d/',
        ),
        (
            {"proc/sys/net/core/rmem_max": "212992"},
            "net.core.rmem_max is 212992 bytes, but a frame of the camera has 262144",
            "echo net.core.rmem_max=1048576 | sudo tee /etc/sysctl.d/90-haselab.conf",
        ),
        (
            {"sys/class/net/eth1/mtu": "1500"},
            "eth1 carries packets of 1500 bytes",
            "sudo ip link set eth1 mtu 9000",
        ),
        ({"sys/class/net/eth1/speed": "100"}, "eth1 is a link of 100 Mbit/s", "Use a cable of"),
        (
            {"proc/net/route": ROUTES + OUT},
            "no network port of this computer is in the camera's network (192.168.1.7)",
            "sudo ip addr add 192.168.1.1/24 dev PORT",
        ),
        (
            {
                "proc/net/route": ROUTES + HERE + HERE.replace("eth1", "eth2"),
                "proc/sys/net/ipv4/conf/all/rp_filter": "1",
            },
            "rp_filter is strict and eth1 is not the only port in the camera's network",
            "sudo sysctl -w net.ipv4.conf.all.rp_filter=2 net.ipv4.conf.eth1.rp_filter=2",
        ),
        (
            {"proc/80/comm": "firewalld"},
            "firewalld is active and may block frames on eth1",
            "firewall-cmd --permanent --zone=trusted --change-interface=eth1",
        ),
        (
            {"etc/ufw/ufw.conf": "ENABLED=yes\n"},
            "ufw is active and may block",
            "sudo ufw allow in on eth1 proto udp",
        ),
        (
            {"sys/module/usbcore/parameters/usbfs_memory_mb": "16"},
            "usbfs_memory_mb is 16",
            "echo 1000 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb",
        ),
        (
            {f"{CAMERA}/speed": "480"},
            "BFS-U3-13Y3M is connected at only 480 Mbit/s (USB 2)",
            "Use a USB 3 port",
        ),
        (
            {f"{CAMERA}/power/control": "auto"},
            "BFS-U3-13Y3M may be suspended",
            f"echo on | sudo tee /{CAMERA}/power/control",
        ),
        (
            {f"{BOARD}/power/control": "auto"},
            "USB-6212 may be suspended",
            f"echo on | sudo tee /{BOARD}/power/control",
        ),
        (
            {f"{BOARD}/product": "USB-6003 (OEM)"},
            "USB-6003 (OEM) is not supported by NI-DAQmx for Linux",
            "Use a Windows computer with NI's gRPC device server, and daq.server",
        ),
        (
            {f"{BOARD}/product": "NI USB-6003"},
            "NI USB-6003 is not supported by NI-DAQmx for Linux",
            "Use a Windows computer with NI's gRPC device server, and daq.server",
        ),
        (
            {f"{BOARD}/product": "NI\nUSB-6212\x1b[2J", f"{BOARD}/power/control": "auto"},
            "NI USB-6212?[2J may be suspended",
            f"echo on | sudo tee /{BOARD}/power/control",
        ),
        (
            {f"{CAMERA}/product": "BFS-U3\r\n13Y3M", f"{CAMERA}/power/control": "auto"},
            "BFS-U3 13Y3M may be suspended",
            f"echo on | sudo tee /{CAMERA}/power/control",
        ),
        (
            {"usr/lib/x86_64-linux-gnu/libnidaqmx.so.1": None},
            "NI-DAQmx is not installed",
            "Install NI Linux Device Drivers for Ubuntu 22.04 from ni.com, or use a Windows",
        ),
        (
            {
                "usr/lib/x86_64-linux-gnu/libnidaqmx.so.1": None,
                "etc/os-release": 'ID=debian\nPRETTY_NAME="Debian GNU/Linux 12"\n',
            },
            "NI-DAQmx is not installed",
            "not for Debian GNU/Linux 12: use a Windows computer",
        ),
        *(
            (
                {
                    "usr/lib/x86_64-linux-gnu/libnidaqmx.so.1": None,
                    "etc/os-release": f"ID=other\nID_LIKE={likes}\nPRETTY_NAME='Other 1'\n",
                },
                "NI-DAQmx is not installed",
                "not for Other 1: use a Windows"
                if like is None
                else f"no packages for Other 1, but has some for the related {like}: try NI Linux "
                f"Device Drivers for {like} from ni.com, or use a Windows",
            )
            for likes, like in [
                ('"ubuntu debian"', "Ubuntu"),
                ("debian", "Ubuntu"),
                ('"rhel centos fedora"', "RHEL"),
                ("arch", None),
            ]
        ),
        (
            {"proc/modules": "usbcore 1 2 - Live 0x0\n"},
            "its kernel module nikal is not loaded",
            "sudo dkms autoinstall",
        ),
        (
            {"proc/self/status": STATUS.format("0000000000000000")},
            "real-time priority is not permitted",
            "sudo tee /etc/security/limits.d/90-haselab.conf",
        ),
        (
            {"dev/ttyACM0": None},
            "/dev/ttyACM0 does not exist",
            "ls /dev/ttyACM* /dev/ttyUSB*",
        ),
    ],
)
def test_each_simulated_fault_is_the_only_one_reported(plant, changed, detail, advice):
    found = bad(plant(changed))
    assert len(found) == 1, found
    assert detail in found[0].detail
    assert advice in found[0].advice
    assert "\n" not in found[0].detail + found[0].advice


def test_devices_of_another_group_are_reported_with_the_group(plant, tmp_path):
    group = (tmp_path / "probe").parent.stat().st_gid
    machine = plant({"etc/group": f"root:x:0:\nuucp:x:{group}:\n"}, mode=0o660)
    group = (tmp_path / "dev/ttyACM0").stat().st_gid
    (tmp_path / "etc/group").write_text(f"uucp:x:{group}:\n")
    printed = {found.name: found for found in bad(machine)}
    assert set(printed) == {"serial port", "USB camera"}
    assert printed["serial port"].advice.startswith("Type: sudo usermod -aG uucp $USER")
    assert 'ENV{ID_USB_INTERFACES}=="*:ef0500:*", MODE="0666"' in printed["USB camera"].advice
    member = Machine(tmp_path, "linux", 12345, frozenset({group}))
    assert bad(member) == []


def test_limits_of_the_user_do_as_well_as_a_capability(plant):
    changed = {
        "proc/self/status": STATUS.format("0000000000000000"),
        "proc/self/limits": LIMITS.format(50, 30),
    }
    assert bad(plant(changed)) == []


def test_the_vendor_of_a_serial_port_is_in_its_rule(plant, tmp_path):
    machine = plant({"run/udev/data/c166:0": "", "sys/devices/usb1/1-4/idVendor": "2341"})
    (tmp_path / "sys/devices/usb1/1-4/1-4:1.0").mkdir()
    link = tmp_path / "sys/class/tty/ttyACM0/device"
    link.symlink_to(tmp_path / "sys/devices/usb1/1-4/1-4:1.0")
    (found,) = bad(machine)
    assert 'SUBSYSTEM=="tty", ATTRS{idVendor}=="2341", ENV{ID_MM_DEVICE' in found.advice


def test_without_modem_manager_a_port_needs_no_rule(plant):
    changed = {"run/udev/data/c166:0": "", "proc/77/comm": "bash"}
    assert bad(plant(changed)) == []


def test_a_camera_by_name_or_none_leaves_the_ports_alone(plant):
    machine = plant({"sys/class/net/eth1/mtu": "1500"})
    for genicam in (None, "Fake_1", "Basler-21876543", "127.0.0.1"):
        assert bad(machine, SystemNeeds(genicam=genicam, frame_bytes=512 * 512)) == []


def test_on_macos_a_local_board_needs_a_server(tmp_path):
    machine = Machine(tmp_path, "darwin", 1, frozenset())
    (found,) = examine_system(machine, SystemNeeds(local_daq=True))
    assert found.detail == "NI-DAQmx is not available for macOS" and "daq.server" in found.advice


@pytest.mark.parametrize("junk", ["", "x", "\x00\xff", "CapEff:", "a b c\nd e"])
def test_what_files_with_junk_do_not_show_is_missing_with_advice(plant, junk):
    changed = {path: junk for path in HEALTHY if not path.startswith("dev/")}
    missing = bad(plant(changed))
    # An empty file of limits or modules is that of a kernel that does not say.
    names = ["NI driver", "network", "real time"] if junk else ["network"]
    assert [each.name for each in missing] == names
    assert all(each.advice.startswith("Type: ") for each in missing)


def test_a_port_with_a_null_character_is_not_there_and_no_fault_of_the_program(plant):
    printed = bad(plant(), SystemNeeds(serial_ports=("/dev/tty\x00x",)))
    assert "does not exist" in printed[0].detail
    assert plant().group("dev/tty\x00x") == "dialout"
