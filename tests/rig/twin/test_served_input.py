"""The served twin answers whatever it is sent, and serves the user who started it alone."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import socket
import stat
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from haselab.rig.drivers import load_driver
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve import lines
from haselab.rig.twin.serve.local_user import LocalUserFilter, can_tell_users, uid_of_client
from haselab.rig.twin.serve.server import ServedTwin

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
LINUX = pytest.mark.skipif(not can_tell_users(), reason="the system does not list owners")
GUARD_S = 300.0  # against a test that never ends
MANY = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(scope="module")
def served() -> Iterator[ServedTwin]:
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as twin:
        yield twin


@contextlib.contextmanager
def client(address: str) -> Iterator[Any]:
    port = int(address.removesuffix("::SOCKET").replace("::", ":").rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), timeout=GUARD_S) as connection:
        yield connection.makefile("rwb")


def asked(stream: Any, line: bytes) -> bytes:
    stream.write(line)
    stream.flush()
    return bytes(stream.readline())


def error_of(stream: Any) -> bytes:
    return asked(stream, b"SYST:ERR?\n")


# ---- what was found -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (b"VOLT:UNIT DBM;:VOLT 1e6\n", b'-222,"Data out of range"\n'),
        (b"VOLT 1e400\n", b'-222,"Data out of range"\n'),
        (b"FREQ nan\n", b'-222,"Data out of range"\n'),
        (b"FREQ " + b"9" * 60_000 + b"\n", b'-222,"Data out of range"\n'),
        (b"\xff\x00[[[\n", b'-113,"Undefined header"\n'),
        (b"*IDN?" * 20_000 + b"\n", b'-363,"Input buffer overrun"\n'),
    ],
)
def test_the_generator_queues_an_error_and_goes_on(
    served: ServedTwin, line: bytes, error: bytes
) -> None:
    with client(served.generator.address) as stream:
        asked(stream, b"*RST;*OPC?\n")
        stream.write(line)
        assert error_of(stream) == error
        assert error_of(stream) == b'+0,"No error"\n'


@pytest.mark.parametrize(
    "line",
    [
        b"[" * 60_000,
        b"[" * 100_000,
        b"1" * 5000,
        b'{"do": "hang", "mass_kg": 1' + b"0" * 400 + b"}",
        b'{"do": "hang", "mass_kg": 1e400}',
        b'{"do": "hang", "mass_kg": true}',
        b'{"do": "hang"}',
        b'{"do": "start_camera", "rate_hz": 1e-300, "exposure_s": 0}',
        b'{"do": ["hang"]}',
        b'{"do": "__init__"}',
        b'"\xff"',
    ],
)
def test_the_stand_refuses_what_is_no_request_and_goes_on(served: ServedTwin, line: bytes) -> None:
    with client(served.client.address) as stream:
        reported = json.loads(asked(stream, line + b"\n"))
        assert reported["error"]
        assert reported["kind"] in {"InputError", "LimitError"}
        assert "output_v" in json.loads(asked(stream, b'{"do": "meters"}\n'))


def test_the_supply_refuses_a_number_of_4400_digits_and_goes_on(served: ServedTwin) -> None:
    with open(served.supply.port, "r+b", buffering=0) as port:  # noqa: PTH123
        for command, reported in (
            (b"SF " + b"1" * 4400, b"Err"),  # its buffer has begun again many times
            (b"SVset \xff", b"0"),
            (b"", b"0"),  # the last command once more
            (b"x" * 100_000, b"Err"),
        ):
            threading.Thread(target=port.write, args=(command + b"\r",)).start()
            assert _read_line(port) == reported
        port.write(b"QName\r")
        assert _read_line(port) == b"haselab-twin"


def _read_line(port: Any) -> bytes:
    reported = b""
    while not reported.endswith(b"\r\n"):
        reported += port.read(1)
    return reported.strip()


def test_unread_replies_do_not_prevent_the_supply_from_closing() -> None:
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as twin:
        port = os.open(twin.supply.port, os.O_RDWR | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(port, b"QName\r" * 100)
    os.close(port)


# ---- any input ------------------------------------------------------------------------------

WORDS = [
    "VOLT",
    "VOLT:UNIT",
    "VOLT:OFFS",
    "FREQ",
    "FUNC",
    "OUTP",
    "OUTP:LOAD",
    "SOUR2:VOLT",
    "*RST",
    "*IDN?",
    "VOLT?",
    "FREQ?",
    "OUTP:LOAD?",
    "VOLT:UNIT?",
    "SYST:ERR?",
    ";",
    ":",
]
NUMBERS = st.one_of(
    st.floats().map(str), st.integers().map(str), st.integers(0, 5000).map(lambda n: "9" * n)
)
PARAMETERS = st.one_of(
    NUMBERS, st.sampled_from(["DBM", "VPP", "VRMS", "INF", "ON", "SIN"]), st.text()
)
SCPI = st.lists(st.tuples(st.sampled_from(WORDS), PARAMETERS).map(" ".join), max_size=5).map(
    ";".join
)
JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=5,
)
ACTS = st.sampled_from(["hang", "start_camera", "stop_camera", "take", "meters", "nothing"])
REQUESTS = st.one_of(
    JSON.map(json.dumps),
    st.builds(
        lambda do, a, b: json.dumps({"do": do, "mass_kg": a, "rate_hz": b}), ACTS, JSON, JSON
    ),
    st.builds(
        lambda do, key, a: json.dumps({"do": do, key: a}),
        ACTS,
        st.sampled_from(["mass_kg", "rate_hz"]),
        st.one_of(st.floats(21.0), st.floats(max_value=-1.0), st.integers(), JSON),
    ),
    st.text(),
)
COMMANDS = st.builds(
    "{}{} {}".format,
    st.sampled_from("QSX"),
    st.sampled_from(["Vset", "SwMode", "F", "Cycle", "Ver", "Vnow", ""]),
    st.one_of(NUMBERS, st.text()),
)


@MANY
@given(line=st.one_of(SCPI, st.text()))
def test_no_line_is_a_defect_of_the_generator(served: ServedTwin, line: str) -> None:
    reported = served.generator.answer(line.encode("ascii", "replace").decode())
    assert reported == b"" or reported.endswith(b"\n")


@MANY
@given(line=REQUESTS)
def test_no_line_is_a_defect_of_the_stand(served: ServedTwin, line: str) -> None:
    head, _, frames = served.client.answer(line).partition(b"\n")
    assert json.loads(head)["bytes"] == len(frames)


@MANY
@given(line=COMMANDS)
@example("SVset ¹")  # a digit that is no number
@example("SVset " + "9" * 5000)  # more digits than int() takes
def test_no_line_is_a_defect_of_the_supply(served: ServedTwin, line: str) -> None:
    assert served.supply.answer(line).isascii()


CALLS = {
    "CreateTask": {"session_name": st.text(max_size=5)},
    "CreateAIVoltageChan": {"physical_channel": st.sampled_from(["Dev1/ai0", "Dev1/x", ""])},
    "CreateAOVoltageChan": {"physical_channel": st.sampled_from(["Dev1/ao0", "x"])},
    "CreateCOPulseChanTicks": {
        "counter": st.just("Dev1/ctr0"),
        "initial_delay": st.integers(-(2**31), 2**31 - 1),
        "low_ticks": st.integers(-(2**31), 2**31 - 1),
        "high_ticks": st.integers(-100, 1000),
    },
    "CreateCICountEdgesChan": {"counter": st.sampled_from(["Dev1/ctr1", "Dev1/ctr9", ""])},
    "CfgSampClkTiming": {
        "rate": st.floats() | st.just(200e3),
        "source": st.sampled_from(["", "x", "/Dev1/PFI0", "/Dev1/Ctr0InternalOutput"]),
        "samps_per_chan": st.integers(0, 2**64 - 1),
    },
    "CfgDigEdgeStartTrig": {"trigger_source": st.sampled_from(["", "/", "/Dev1/ai/StartTrigger"])},
    "SetTrigAttributeInt32": {"attribute_raw": st.sampled_from([0x1414, 0x1415, 1])},
    "SetTrigAttributeString": {"attribute_raw": st.just(0x1417), "value": st.text(max_size=3)},
    "SetChanAttributeString": {"attribute_raw": st.just(0x18C7), "value": st.text(max_size=3)},
    "SetBufferAttributeUInt32": {
        "attribute_raw": st.sampled_from([0x186C, 0x186D, 1]),
        "value": st.integers(0, 2**32 - 1),
    },
    "GetTimingAttributeDouble": {"attribute_raw": st.sampled_from([0x1344, 0x1848, 0x1317, 1])},
    "GetTrigAttributeDouble": {"attribute_raw": st.sampled_from([0x1856, 1])},
    "SetReadAttributeInt32": {
        "attribute_raw": st.just(0x190B),
        "value_raw": st.integers(-(2**31), 2**31 - 1),
    },
    "ReadAnalogF64": {
        "num_samps_per_chan": st.integers(-(2**31), 2**31 - 1),
        "timeout": st.floats(),
    },
    "ReadCounterU32Ex": {"num_samps_per_chan": st.integers(-(2**31), 2**31 - 1)},
    "WriteAnalogF64": {"write_array": st.lists(st.floats(), max_size=4)},
    "WriteAnalogScalarF64": {"value": st.floats()},
    "StartTask": {},
    "StopTask": {},
    "ClearTask": {},
    "TaskControl": {"action_raw": st.integers(0, 9)},
    "GetReadAttributeUInt32": {"attribute_raw": st.integers(0, 2**31 - 1)},
    "GetReadAttributeUInt64": {"attribute_raw": st.integers(0, 2**31 - 1)},
}


@pytest.fixture(scope="module")
def channel(served: ServedTwin) -> Iterator[Any]:
    grpc = pytest.importorskip("grpc")
    with grpc.insecure_channel(served.daq.address) as opened:
        yield opened


def _called(channel: Any, name: str, message: bytes) -> tuple[str, str]:
    """Status and text of a call, whatever the message is."""
    import grpc

    method = channel.unary_unary(f"/nidaqmx_grpc.NiDAQmx/{name}")
    try:
        method(message, timeout=GUARD_S)
    except grpc.RpcError as error:
        return error.code().name, error.details()
    return "OK", ""


@MANY
@given(data=st.data())
def test_no_call_is_a_defect_of_the_board(channel: Any, data: st.DataObject) -> None:
    nidaqmx_pb2 = load_driver("nidaqmx._stubs.nidaqmx_pb2", "This test")
    session_pb2 = load_driver("session_pb2", "This test")
    name = data.draw(st.sampled_from(sorted(CALLS)))
    request = getattr(nidaqmx_pb2, f"{name}Request")(
        **{key: data.draw(values) for key, values in CALLS[name].items()}
    )
    if name != "CreateTask":
        request.task.CopyFrom(session_pb2.Session(id=data.draw(st.integers(1, 3))))
    code, text = _called(channel, name, request.SerializeToString())
    assert code in {"OK", "UNKNOWN"}, text
    assert "Exception calling application" not in text


@MANY
@given(name=st.sampled_from(sorted(CALLS)), message=st.binary(max_size=40))
def test_no_malformed_message_ends_the_board(channel: Any, name: str, message: bytes) -> None:
    code, text = _called(channel, name, message)
    assert code in {"OK", "UNKNOWN", "INTERNAL"}, text
    assert "Exception calling application" not in text


# ---- who is served --------------------------------------------------------------------------


@LINUX
def test_the_owner_of_a_connection_is_found_over_both_kinds_of_socket() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        for family, host in ((socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::ffff:127.0.0.1")):
            with socket.socket(family) as caller:
                caller.connect((host, server.getsockname()[1]))
                connection, address = server.accept()
                with connection:
                    assert uid_of_client(address, server.getsockname()) == os.getuid()
    assert uid_of_client(("127.0.0.1", 1), ("127.0.0.1", 2)) is None


@LINUX
def test_a_client_that_has_closed_its_end_has_no_user() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        socket.create_connection(server.getsockname()).close()
        connection, address = server.accept()
        with connection:
            assert uid_of_client(address, server.getsockname()) is None


@LINUX
@pytest.mark.parametrize("owner", [None, -5])
def test_other_users_and_unknown_ones_are_refused_unless_allowed(owner: int | None) -> None:
    def lookup(client: object, server: object) -> int | None:
        return owner

    assert not LocalUserFilter(1, lookup=lookup).admits(("127.0.0.1", 40000))
    assert LocalUserFilter(1, lookup=lookup, allow_others=True).admits(("127.0.0.1", 40000))


@LINUX
def test_an_address_is_looked_up_again_after_half_a_second_without_a_call() -> None:
    clock_s, owner = [100.0], os.getuid()
    gate = LocalUserFilter(1, lookup=lambda client, server: owner, clock=lambda: clock_s[0])
    address = ("127.0.0.1", 40000)
    assert gate.admits_call(address)
    owner += 1
    for clock_s[0] in (100.4, 100.8, 101.2):
        assert gate.admits_call(address), "one look a connection, not one a call"
    clock_s[0] = 101.8
    assert not gate.admits_call(address)
    owner, clock_s[0] = os.getuid(), 101.9
    assert gate.admits_call(address)


@LINUX
def test_a_client_of_another_user_reads_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines.LocalUserFilter, "admits", lambda gate, address: False)
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as twin:
        with client(twin.generator.address) as stream, contextlib.suppress(ConnectionError):
            assert asked(stream, b"*IDN?\n") == b""
        grpc = pytest.importorskip("grpc")
        with grpc.insecure_channel(twin.daq.address) as channel:
            code, text = _called(channel, "CreateTask", b"")
        assert code == "PERMISSION_DENIED"
        assert "--allow-other-users" in text


def test_the_port_of_the_supply_is_for_its_user_alone(served: ServedTwin) -> None:
    assert stat.S_IMODE(os.stat(served.supply.port).st_mode) == 0o600  # noqa: PTH116


def test_a_seventeenth_client_is_turned_away_and_a_place_that_is_left_is_given_again(
    served: ServedTwin,
) -> None:
    with contextlib.ExitStack() as opened:
        streams = [opened.enter_context(client(served.client.address)) for _ in range(16)]
        assert all(asked(stream, b'{"do": "meters"}\n') for stream in streams)
        with client(served.client.address) as late, contextlib.suppress(ConnectionError):
            assert asked(late, b'{"do": "meters"}\n') == b""
    assert math.isfinite(served.hub.output_v)


def test_the_rig_file_has_the_numbers_of_the_twin_in_their_shortest_form():
    """A product and its quotient, such as 3 * 0.0498 / 3, differ from 0.0498 in the last bit."""
    config = twin_of_reading("hz")
    with ServedTwin(config, 1, pace=0.0) as served:
        text = served.rig_file()
    assert f"shell_width_m = {config.shell.width_m!r}\n" in text
    assert f"shell_thickness_m = {config.shell.thickness_m!r}\n" in text
    assert not re.search(r"\d{13}", text)
