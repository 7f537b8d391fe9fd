"""The server of sessions: clients at once, mistakes, encodings and signals."""

import asyncio
import base64
import gzip
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
from aiohttp import web

import chsel
from replay.comparing.verification import EQUAL, NO_RESULT, verify
from replay.mcap.reader import read_recording
from runners.serving.server import Server
from tests.chsel.samples import REPOSITORY

TOKEN = "a token"
BOX, HAND = (trimesh.creation.box(sides) for sides in ((0.1, 0.06, 0.2), (0.02, 0.02, 0.1)))
TARGET, OF_HAND = (
    {"vertices": mesh.vertices.tolist(), "faces": mesh.faces.tolist()} for mesh in (BOX, HAND)
)
ON_BOX = [[-0.05, 0.02, 0.05], [-0.05, -0.02, -0.07], [0.05, 0.01, 0.08], [0.05, -0.01, -0.05]]
ON_BOX += [[0.03, 0.02, 0.1], [-0.04, -0.02, 0.1], [0.0, -0.03, -0.04], [-0.02, 0.03, 0.05]]


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """The address of a server in a thread, and the folder of its recordings."""
    folder = tmp_path_factory.mktemp("served")
    listening = socket.create_server(("127.0.0.1", 0))
    options = {"sock": listening, "handle_signals": False, "print": None}
    options["loop"] = asyncio.new_event_loop()
    served = (Server(TOKEN, folder).app,)
    threading.Thread(target=web.run_app, args=served, kwargs=options, daemon=True).start()
    return f"127.0.0.1:{listening.getsockname()[1]}", folder


def ask(address, path, body=None, *, token=TOKEN, encoding="", **values):
    """The status and the answer to JSON of values, or to a body; without both, to a GET."""
    body = json.dumps(values).encode() if body is None and values else body
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    headers |= {"Content-Encoding": encoding} if encoding else {}
    request = urllib.request.Request(f"http://{address}{path}", body, headers)
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def opened(address, **values):
    """The path of a new session of the box."""
    status, answer = ask(address, "/sessions", target=TARGET, **values)
    assert status == 200, answer
    return f"/sessions/{answer['session']}"


def outcomes(path):
    """The steps that were verified, and how the recording ended."""
    recording = read_recording(path)
    verdicts = list(verify(recording))
    assert {verdict.outcome for verdict in verdicts} == {EQUAL}
    return [verdict.step for verdict in verdicts], recording.ended.outcome


def test_two_clients_at_once_get_what_the_library_gives_and_recordings_repeat(server):
    (address, folder) = server
    places = np.array([[0.4, 0.1, 0.2], [0.8, -0.1, 0.3]])

    def client(number):
        path = opened(address, seed=number, hand=OF_HAND, record=f"client_{number}.mcap")
        contacts = (places[number] + ON_BOX).tolist()
        ask(address, f"{path}/add", contacts=contacts[:4])
        ask(address, f"{path}/register", body=b"")
        _, probe = ask(address, f"{path}/next_probe", body=b"{}")
        _, added = ask(address, f"{path}/add", contacts=contacts[4:])
        assert added["points"] == {"known": 8, "free": 0, "occupied": 0}
        _, found = ask(address, f"{path}/register", body=b"{}")
        assert ask(address, f"{path}/close", body=b"") == (200, {"step": 1})
        return probe, found

    with ThreadPoolExecutor(2) as pool:
        clients = list(pool.map(client, range(2)))
    for number, (probe, found) in enumerate(clients):
        with chsel.Session(BOX, seed=number, hand=HAND) as session:
            session.add(contacts=(places[number] + ON_BOX)[:4])
            session.register()
            assert probe["world_from_hand"] == session.next_probe().world_from_hand.tolist()
            session.add(contacts=(places[number] + ON_BOX)[4:])
            assert found["object_from_world"] == session.register().object_from_world.tolist()
            assert found["trust"]["text"] == str(session.trust)
        poses = np.array(found["world_from_object"])
        assert np.allclose(poses[0, :3, 3], places[number], atol=0.001)
        assert np.allclose(poses @ found["object_from_world"], np.eye(4), atol=1e-12)
        assert outcomes(folder / f"client_{number}.mcap") == ([0, 0, 1], "finished")


def test_normals_are_recorded_as_those_of_the_library(server):
    address, folder = server
    path = opened(address, record="normals.mcap")
    normals = [[0, 0, 1], [0, 0, 0], [0, 1.005, 0]]
    given = {"contacts": ON_BOX[:3], "normals": normals, "normal_noise": [0.1, 0, 0.3]}
    assert ask(address, f"{path}/add", **given)[0] == 200
    touch = {"contact": ON_BOX[3], "normal": [-1, 0, 0], "normal_noise": 0.2}
    assert ask(address, f"{path}/add", **touch)[0] == 200
    ask(address, f"{path}/close", body=b"")
    probes = read_recording(folder / "normals.mcap").probes
    points = chsel.KnownPoints.joined([probe.new_points for probe in probes])
    expected = [[0, 0, 1], [0, 0, 0], [0, 1, 0], [-1, 0, 0]]
    np.testing.assert_allclose(points.normals, expected, atol=1e-15)
    np.testing.assert_array_equal(points.normal_noise, [0.1, 0.0, 0.3, 0.2])


def test_a_symmetry_is_that_of_the_library(server):
    address, folder = server
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    path = opened(address, record="symmetry.mcap", symmetry={"turns": [half.tolist()]})
    ask(address, f"{path}/add", contacts=ON_BOX)
    status, found = ask(address, f"{path}/register", body=b"")
    assert status == 200
    assert found["pose"] == found["world_from_object"][0]
    ask(address, f"{path}/close", body=b"")
    recorded = read_recording(folder / "symmetry.mcap").start.sdf.symmetry
    np.testing.assert_allclose(recorded.rotations, [np.eye(3), half[:3, :3]], atol=1e-12)
    assert ask(address, "/sessions", target=TARGET, symmetry="all")[0] == 400


def test_a_session_goes_on_from_a_recording_of_the_server(server):
    address, folder = server
    path = opened(address, record="monday.mcap")
    ask(address, f"{path}/add", contacts=ON_BOX[:4])
    first = ask(address, f"{path}/register", body=b"")[1]
    ask(address, f"{path}/add", contacts=ON_BOX[4:])
    second = ask(address, f"{path}/register", body=b"")[1]
    ask(address, f"{path}/close", body=b"")
    given = {"source": "monday.mcap", "record": "tuesday.mcap", "step": 0}
    status, answer = ask(address, "/sessions", **given)
    assert (status, answer["step"]) == (200, 0)
    path = f"/sessions/{answer['session']}"
    found = ask(address, f"{path}/register", body=b"")[1]
    assert found["object_from_world"] == first["object_from_world"]
    ask(address, f"{path}/add", contacts=ON_BOX[4:])
    found = ask(address, f"{path}/register", body=b"")[1]
    assert found["object_from_world"] == second["object_from_world"]
    ask(address, f"{path}/close", body=b"")
    assert outcomes(folder / "tuesday.mcap") == ([0, 1], "finished")
    for wrong, text in (
        ({"source": "../monday.mcap"}, "source is '../monday.mcap'; accepted: a name"),
        ({"source": "monday.mcap", "step": 5}, "has no step 5; accepted: 0 to 1"),
        ({"source": "none.mcap"}, "none.mcap"),
        ({"source": "monday.mcap", "target": TARGET}, "target"),
    ):
        status, answer = ask(address, "/sessions", **wrong)
        assert status == 400
        assert text in answer["error"]


def test_a_prior_is_that_of_the_library(server):
    address, folder = server
    prior = {"centre": [0.0, 0.01, 0.0], "centre_noise": 0.02}
    upright = {"axis": [0, 0, 2], "along": [0, 0, 1], "axis_noise": 0.1}
    path = opened(address, record="prior.mcap", prior=prior | upright)
    ask(address, f"{path}/add", contacts=ON_BOX)
    assert ask(address, f"{path}/register", body=b"")[0] == 200
    ask(address, f"{path}/close", body=b"")
    recording = read_recording(folder / "prior.mcap")
    assert recording.problem(0).prior.digest == chsel.PosePrior(**prior, **upright).digest
    assert outcomes(folder / "prior.mcap") == ([0], "finished")
    for wrong, text in (
        ({"center": [0, 0, 0]}, "prior.center does not exist; accepted: centre, centre_noise"),
        ({"centre": [0, 0, 0]}, "prior: the prior has centre without centre_noise"),
        (7, "prior is 7; accepted: a mapping of centre"),
        (prior | {"centre_noise": "a"}, "prior: centre_noise is 'a'"),
    ):
        status, answer = ask(address, "/sessions", target=TARGET, prior=wrong)
        assert status == 400
        assert answer["error"].startswith(text)


def test_others_are_answered_during_a_registration_and_its_own_session_waits(server, monkeypatch):
    address, _ = server
    path, other = opened(address), opened(address)
    entered = threading.Event()
    go_on = threading.Event()
    register = chsel.Session.register

    def slow(session):
        entered.set()
        assert go_on.wait(600)
        return register(session)

    ask(address, f"{path}/add", contacts=ON_BOX)
    monkeypatch.setattr(chsel.Session, "register", slow)
    with ThreadPoolExecutor(2) as pool:
        registered = pool.submit(ask, address, f"{path}/register", b"")
        assert entered.wait(600)
        added = pool.submit(ask, address, f"{path}/add", contacts=ON_BOX[:1])
        assert ask(address, f"{other}/add", contacts=ON_BOX)[0] == 200
        steps = {one["session"]: one["step"] for one in ask(address, "/sessions")[1]["sessions"]}
        go_on.set()
    assert [steps[one.rpartition("/")[2]] for one in (path, other)] == [0, 0]
    assert registered.result()[1]["step"] == 0
    assert added.result()[1]["step"] == 1


def packed(shape, data=b"\0" * 24, *, dtype="float32"):
    return {"dtype": dtype, "shape": shape, "base64": base64.b64encode(data).decode()}


def test_a_mistake_is_one_line(server):
    address, folder = server
    path = opened(address)
    box = {"target": TARGET}
    (folder / "there.mcap").touch()
    for where, body, text in (
        ("", [1], "the body is [1]; accepted: a JSON object"),
        ("", {"target": 5}, "target is 5; accepted: the path of a mesh, or vertices and faces"),
        ("", {"target": {"vertices": 0, "faces": None}}, "target: vertices has shape (); accepted"),
        ("", {"seed": "x", "target": 0}, "open.seed is 'x'; accepted: an integer"),
        ("", box | {"record": "../a.mcap"}, "record is '../a.mcap'; accepted: a name, of a file"),
        ("", box | {"record": "there.mcap"}, f"recording {folder}/there.mcap"),
        ("/add", {"contacts": [[1, 2]]}, "contacts has shape (1, 2); accepted: (any, 3)"),
        ("/add", {"free": "x"}, "free is not an array of numbers; accepted: nested lists"),
        ("/add", {"free": packed([3, 3])}, "free is not an array of numbers; accepted"),
        ("/add", {"contact": [0, 0, None]}, "contact[2] is not finite"),
        ("/add", {"contcts": []}, "a name in add is 'contcts'; accepted: contacts, normals"),
        ("/add", {"normals": [[0, 0, 1]]}, "normals have no contacts; accepted: both"),
        (
            "/add",
            {"contacts": [[0, 0, 1]], "normals": [[0, 0, 1.02]]},
            "normals[0] is 1.02 long; accepted: unit vectors out of the object",
        ),
        (
            "/add",
            {"contact": [0, 0, 1], "normal": [0, 0, 1], "normal_noise": 15},
            "normal_noise is 15; in degrees? accepted: above 0, up to pi, radians",
        ),
        ("/add", {"contact": [0, 0, 1], "normal": [0, None, 1]}, "normal[1] is not finite"),
        ("/register", {}, "nothing is known yet; accepted: a registration after `add`"),
        ("/next_probe", {"length": [1]}, "actions are incomplete; accepted:"),
    ):
        whole = f"{path}{where}" if where else "/sessions"
        status, answer = ask(address, whole, body=json.dumps(body).encode())
        assert (status, answer["error"][: len(text)]) == (400, text)
        assert "\n" not in answer["error"]
    assert ask(address, "/sessions", body=b"{")[1]["error"].startswith(
        "the body is not JSON (Expecting"
    )
    for where, body, text in (
        (
            "/sessions",
            {"record": "a\0.mcap"},
            "record is 'a\\x00.mcap'; accepted: a name, of a file",
        ),
        ("/sessions", {"record": f"{'a' * 5000}.mcap"}, f"recording {folder}/aaaa"),
        ("/sessions", {"target": "a\0.obj"}, "mesh file a\\x00.obj does not exist; accepted: "),
        ("/sessions", {"target": f"{'a' * 5000}.obj"}, ""),
        ("/sessions", {"method": "a" * 5000}, "method is "),
    ):
        status, answer = ask(address, where, **(box | body))
        assert (status, answer["error"][: len(text)]) == (400, text)
        assert "\n" not in answer["error"]
    assert ask(address, f"/sessions/{'a' * 20_000}/add", body=b"")[0] == 404
    assert [ask(address, f"{path}/close", body=b"")[0] for _ in range(2)] == [200, 404]
    refused = "the token is missing or wrong; accepted: Authorization: Bearer TOKEN"
    for token in ("", TOKEN[:-1], f"{TOKEN}."):
        for where in ("/sessions", "/elsewhere"):
            assert ask(address, where, token=token) == (401, {"error": refused})


def test_a_body_is_unpacked_where_it_says_how(server):
    address, _ = server
    path = opened(address)
    values = json.dumps({"contacts": ON_BOX}).encode()
    squeezed, whole = gzip.compress(values), zlib.compress(values)
    for encoding, body, status, text in (
        ("gzip", squeezed, 200, ""),
        ("deflate", whole, 200, ""),
        ("identity", values, 200, ""),
        ("gzip", squeezed[:-9], 400, "the body in gzip is cut, or too long; accepted: a whole one"),
        ("gzip", values, 400, "the body is not gzip (Error -3"),
        ("br", values, 400, "Content-Encoding is 'br'; accepted: gzip, deflate, or none"),
        ("zstd", values, 400, "Content-Encoding is 'zstd'; accepted: "),
        ("x" * 5000, values, 400, "Content-Encoding is "),
    ):
        found = ask(address, f"{path}/add", body=body, encoding=encoding)
        assert found[0] == status
        assert found[1].get("error", "").startswith(text)
    assert ask(address, "/sessions")[1]["sessions"][-1]["step"] == 2


def test_a_client_that_hangs_up_leaves_the_session_and_its_recording_whole(server):
    address, folder = server
    path = opened(address, record="left.mcap")
    head = f"POST {path}/{{}} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\n"
    ask(address, f"{path}/add", contacts=ON_BOX)
    for rest in (b"Content-Length: 99\r\n\r\n{", b"Content-Length: 2\r\n\r\n{}"):
        with socket.create_connection(address.split(":")) as connection:
            connection.sendall(head.format("register").encode() + rest)
    status, answer = ask(address, f"{path}/register", body=b"{}")
    assert (status, answer["step"]) == (200, 0)
    ask(address, f"{path}/close", body=b"")
    assert outcomes(folder / "left.mcap") == ([0], "finished")


def test_packed_arrays_are_the_same_as_lists(server):
    above = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]]
    camera = {"camera": [[60, 0, 7.5], [0, 60, 5.5], [0, 0, 1]], "world_from_camera": above}
    depth = 470 + np.arange(192).reshape(12, 16)
    mask = np.arange(192).reshape(12, 16) % 16 < 11
    scaled = packed(depth.shape, depth.astype("<u2").tobytes(), dtype="uint16") | {"scale": 0.001}
    ways = {
        "lists": {"depth": (0.001 * depth).tolist(), "mask": mask.tolist()},
        "packed": {"depth": scaled, "mask": packed(mask.shape, mask.tobytes(), dtype="uint8")},
    }
    for name, way in ways.items():
        path = opened(server[0], record=f"{name}.mcap")
        assert ask(server[0], f"{path}/add", **way, **camera)[0] == 200
        ask(server[0], f"{path}/close", body=b"")
    first, second = ((server[1] / f"{name}.mcap").read_bytes() for name in ways)
    assert first == second


@pytest.mark.skipif(os.name == "nt", reason="there are no such signals on Windows")
@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM])
def test_the_command_serves_until_a_signal_whatever_clients_do(tmp_path, ending):
    command = [sys.executable, "-m", "runners.serve", "port=0", f"folder={tmp_path}"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    environment.pop("CHSEL_TOKEN", None)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    served = subprocess.Popen(command, **pipes, text=True, env=environment)
    lines = iter(served.stdout.readline, "")
    address = next(found[1] for line in lines if (found := re.search(r"http://([\d.:]+)", line)))
    token = next(lines).removeprefix("token: ").strip()
    ask(address, "/sessions", token=token, target=TARGET, record="open.mcap")
    ask(address, "/sessions/1/add", token=token, contacts=ON_BOX)
    assert ask(address, "/sessions/1/register", body=b"", token=token)[0] == 200
    stalled = []
    line = "POST /sessions/1/add HTTP/1.1\r\nHost: x\r\n"
    parts = ("Content-Length: 9\r\n\r\n{", "Transfer-Encoding: chunked\r\n\r\n9\r\n{", "")
    for part in parts:  # half a body, half a chunk, half of the headers
        for hangs_up in (True, False):
            connection = socket.create_connection(address.split(":"))
            connection.sendall(f"{line}Authorization: Bearer {token}\r\n{part}".encode())
            stalled.append(connection)
            if hangs_up:
                time.sleep(0.1)  # so that it is read by then
                connection.close()
    with socket.create_connection(address.split(":")) as connection:
        connection.sendall(b"no HTTP\r\n\r\n")
        assert connection.recv(12) == b"HTTP/1.0 400"
    served.send_signal(ending)
    begun = time.monotonic()
    assert served.wait() == 0
    assert time.monotonic() - begun < 5.0  # 60 s if clients are waited for
    assert outcomes(tmp_path / "open.mcap") == ([0], "interrupted")
    assert served.stderr.read() == ""


def test_the_end_waits_for_no_computation_and_what_waits_is_not_begun(tmp_path, monkeypatch):
    entered = threading.Event()
    go_on = threading.Event()
    begun = []

    def slow(session):
        begun.append(session)
        entered.set()
        assert go_on.wait(600)
        return found(session)

    found = chsel.Session.register
    monkeypatch.setattr(chsel.Session, "register", slow)
    listening = socket.create_server(("127.0.0.1", 0))
    loop = asyncio.new_event_loop()
    address = f"127.0.0.1:{listening.getsockname()[1]}"
    runner = web.AppRunner(Server(TOKEN, tmp_path).app, shutdown_timeout=0.5)
    loop.run_until_complete(runner.setup())
    loop.run_until_complete(web.SockSite(runner, listening).start())
    running = threading.Thread(target=loop.run_forever)
    running.start()
    busy, idle = (opened(address, record=f"{name}.mcap") for name in ("busy", "idle"))
    for path in (busy, idle):
        ask(address, f"{path}/add", contacts=ON_BOX)
    with ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(ask, address, f"{busy}/register", b"")]
        assert entered.wait(600)
        asked.append(pool.submit(ask, address, f"{busy}/register", b""))
        time.sleep(0.2)  # so that it waits
        ended = asyncio.run_coroutine_threadsafe(runner.cleanup(), loop)
        ended.result()
        for name in ("busy", "idle"):
            assert is_interrupted(tmp_path / f"{name}.mcap")
        for answer in asked:
            assert isinstance(answer.exception(), http.client.RemoteDisconnected)
        go_on.set()
    loop.call_soon_threadsafe(loop.stop)
    running.join()
    assert len(begun) == 1
    assert is_interrupted(tmp_path / "busy.mcap")  # still


def is_interrupted(path):
    """Whether a recording has ended so, with no result."""
    recording = read_recording(path)
    assert {verdict.outcome for verdict in verify(recording)} <= {NO_RESULT}
    return recording.ended.outcome == "interrupted"


@pytest.mark.skipif(os.name == "nt", reason="there is no such signal on Windows")
def test_the_command_ends_within_a_second_during_a_long_registration(tmp_path):
    command = [sys.executable, "-m", "runners.serve", "port=0", f"folder={tmp_path}"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "CHSEL_TOKEN": TOKEN}
    served = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    lines = iter(served.stdout.readline, "")
    address = next(found[1] for line in lines if (found := re.search(r"http://([\d.:]+)", line)))
    long = {"iterations": 100_000, "stop_below": None}
    path = opened(address, record="long.mcap", method="icp", settings=long)
    ask(address, f"{path}/add", contacts=ON_BOX)
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(ask, address, f"{path}/register", b"")
        time.sleep(2.0)  # so that it is begun
        assert not asked.done()
        served.send_signal(signal.SIGTERM)
        begun = time.monotonic()
        assert served.wait() == 0
        assert time.monotonic() - begun < 5.0  # minutes if the result is waited for
        cut = isinstance(asked.exception(), http.client.RemoteDisconnected | ConnectionError)
        assert cut or asked.result()[0] == 400  # where the registration noticed in time
    assert is_interrupted(tmp_path / "long.mcap")


@pytest.mark.parametrize("kind", ["py", "cpp"])
def test_clients_without_this_package_find_the_box(server, tmp_path, kind):
    source = str(REPOSITORY / "examples" / f"serve_client.{kind}")
    client = [sys.executable, "-I", source]
    if kind == "cpp":
        if shutil.which("c++") is None:
            pytest.skip("there is no C++ compiler, c++")
        client = [str(tmp_path / "client")]
        subprocess.run(["c++", "-std=c++17", "-Wall", "-Werror", source, "-o", *client], check=True)
    client.append(server[0].rpartition(":")[2])
    done, refused = (
        subprocess.run(client, env={"CHSEL_TOKEN": token}, capture_output=True, text=True)
        for token in (TOKEN, "another")
    )
    assert done.returncode == 0, done.stderr
    position = [float(number) for number in done.stdout.splitlines()[0].split()[1:]]
    assert np.allclose(position, [0.4, 0.0, 0.1], atol=0.002)
    assert refused.returncode == 1
    assert "the token is missing or wrong" in refused.stderr
    assert read_recording(server[1] / f"{kind}.mcap").ended.outcome == "finished"
