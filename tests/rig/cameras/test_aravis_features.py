"""A GenICam camera with features that Aravis' own does not have: its description is rewritten."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from haselab.base import DeviceError
from haselab.rig.cameras.aravis.library import AravisLibrary

RESULTING = '<Float Name="{}"><Value>{}</Value></Float>'
THROUGHPUT = (
    '<Enumeration Name="DeviceLinkThroughputLimitMode">'
    '<EnumEntry Name="Off"><Value>0</Value></EnumEntry>'
    '<EnumEntry Name="On"><Value>1</Value></EnumEntry><Value>1</Value></Enumeration>'
    '<Integer Name="DeviceLinkThroughputLimit"><Value>10000000</Value></Integer>'
)
REGISTER = (
    '<IntReg Name="{0}Register"><Address>{1}</Address><Length>4</Length>'
    "<AccessMode>RW</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign>"
    "<Endianess>BigEndian</Endianess></IntReg>"
)


def choice(name: str, address: str, entries: tuple[str, ...]) -> str:
    listed = "".join(
        f'<EnumEntry Name="{entry}"><Value>{k}</Value></EnumEntry>'
        for k, entry in enumerate(entries)
    )
    kept = REGISTER.format(name, address)
    return f'<Enumeration Name="{name}">{listed}<pValue>{name}Register</pValue></Enumeration>{kept}'


LINES = (
    choice("LineSelector", "0x8000", ("Line1", "Line2"))
    + choice("LineMode", "0x8004", ("Input", "Output"))
    + choice("LineSource", "0x8008", ("Off", "ExposureActive"))
    + '<Boolean Name="LineInverter"><pValue>LineInverterRegister</pValue></Boolean>'
    + REGISTER.format("LineInverter", "0x800c")
)

SCRIPT = """
import ctypes, json, sys
from haselab.base import HaselabError
from haselab.rig.cameras.aravis.source import AravisSource
from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.config import AravisConfig
from haselab.rig.cameras.source import ExposureLine
asked = json.loads(sys.argv[2])
library = ctypes.CDLL(AravisLibrary()._aravis._name)
library.arv_set_fake_camera_genicam_filename(sys.argv[1].encode())
line = ExposureLine(**asked["line"]) if asked.get("line") else None
try:
    config = AravisConfig(kind="aravis", name="Fake_1", **asked.get("camera", {}))
    source = AravisSource(config, line)
    source.start(asked["rate_hz"])
    print("started", *(source._features.text(n) for n in asked.get("tell", ())))
    if asked.get("number"):
        print(source._features.number(asked["number"]))
    source.close()
except HaselabError as error:
    print(type(error).__name__, error)
"""

Camera = Callable[..., str]


@pytest.fixture
def camera(tmp_path: Path) -> Camera:
    """In a process of its own: a camera keeps the description that it was made with."""
    try:
        library = AravisLibrary()
    except DeviceError as missing:
        pytest.skip(str(missing))
    library.get("enable_interface", b"Fake")
    opened = library.call("camera_new", b"Fake_1")
    aravis = ctypes.CDLL(library._aravis._name)
    aravis.arv_camera_get_device.restype = ctypes.c_void_p
    aravis.arv_camera_get_device.argtypes = (ctypes.c_void_p,)
    aravis.arv_device_get_genicam_xml.restype = ctypes.c_char_p
    aravis.arv_device_get_genicam_xml.argtypes = (ctypes.c_void_p, ctypes.c_void_p)
    size = ctypes.c_size_t()
    device = aravis.arv_camera_get_device(opened)
    text = aravis.arv_device_get_genicam_xml(device, ctypes.byref(size))[: size.value].decode()
    library.release(opened)

    def tried(features: str, **asked: object) -> str:
        path = tmp_path / "camera.xml"
        head, end = text.split("</RegisterDescription>")
        path.write_text(f"{head}{features}</RegisterDescription>{end}")
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(path), json.dumps({"rate_hz": 100.0} | asked)],
            capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    return tried


@pytest.mark.parametrize(
    "name",
    [
        "ResultingFrameRate",
        "AcquisitionResultingFrameRate",
        "BslResultingAcquisitionFrameRate",
        "ResultingFrameRateAbs",
    ],
)
def test_a_camera_that_says_it_will_be_slower_is_refused_with_its_rate(camera, name):
    reported = camera(RESULTING.format(name, 62.5), camera={"exposure_s": 2e-3})
    assert reported.startswith(
        "LimitError The frame rate is set to 100 Hz, but camera Fake_1 reaches only 62.5 Hz with "
        "these settings. Shorten camera.exposure_s, lower camera.height_px"
    )
    assert reported.count("\n") == 1
    assert camera(RESULTING.format(name, 99.9)).startswith("started")


def test_an_exposure_that_is_longer_than_a_period_is_the_cause_that_is_named(camera):
    reported = camera(RESULTING.format("ResultingFrameRate", 48.0), camera={"exposure_s": 0.02})
    assert "The exposure of 20 ms is longer than a frame period of 10 ms. Shorten" in reported


def test_the_limit_of_the_link_is_the_cause_that_is_named(camera):
    xml = RESULTING.format("ResultingFrameRate", 38.0) + THROUGHPUT
    reported = camera(xml, camera={"exposure_s": 2e-3})
    # 512 x 512 pixels at 100 Hz
    assert (
        "The frames need 26.21 MB/s, but DeviceLinkThroughputLimit is 10 MB/s. Raise it" in reported
    )
    assert "arv-tool-0.8 control DeviceLinkThroughputLimit=28835840" in reported


def test_the_exposure_is_put_on_the_line_of_the_rig_file(camera):
    reported = camera(
        LINES,
        camera={"exposure_s": 2e-3},
        line={"duration_s": 2e-3, "line": "Line2", "inverted": True},
        tell=["LineSelector", "LineMode", "LineSource"],
        number="LineInverterRegister",
    )
    assert reported == "started Line2 Output ExposureActive\n1.0\n"


def test_a_line_that_the_camera_does_not_have_is_one_line(camera):
    line = {"duration_s": 2e-3, "line": "Line7"}
    reported = camera(LINES, camera={"exposure_s": 2e-3}, line=line)
    assert "exposure.line = 'Line7' cannot output the exposure signal: " in reported
    assert "Change exposure.line (arv-tool-0.8 features lists" in reported
    assert reported.count("\n") == 1
    assert "DeviceError" in camera("", camera={"exposure_s": 2e-3}, line=line)


def test_another_exposure_than_the_file_says_is_refused(camera):
    reported = camera("", line={"duration_s": 2e-3})  # the camera is left at its own 10 ms
    assert reported.startswith(
        "LimitError exposure.duration_s is 0.002 s, but camera Fake_1 exposes for 0.01 s. Set "
        "camera.exposure_s"
    )
