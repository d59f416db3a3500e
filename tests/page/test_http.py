"""What programs get of the page."""

from __future__ import annotations

import http.client
import io
import json
import socket
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Holod, wait_for
from PIL import Image
from prometheus_client.openmetrics.parser import text_string_to_metric_families

Start = Callable[..., Holod]
TOKEN = "0123456789abcdef0123"


def figures(holod: Holod) -> dict[str, list]:
    """Prometheus's own reading of the figures, by name."""
    answer, body = holod.get("/metrics")
    assert answer.getheader("content-type", "").startswith("application/openmetrics-text; version=1.0.0")
    return {family.name: family.samples for family in text_string_to_metric_families(body.decode())}


def value(samples: list, suffix: str = "", **labels: str) -> float:
    [sample] = [s for s in samples if s.name.endswith(suffix) and labels.items() <= s.labels.items()]
    return sample.value


def test_figures_are_openmetrics_and_agree_with_the_status(start: Start) -> None:
    holod = start()
    before = holod.status()

    def lit() -> dict[str, list] | None:
        seen = figures(holod)
        has_light = value(seen["holod_sample_to_photon_seconds"], "_count") > 0
        return seen if has_light and value(seen["holod_lasers_armed"]) == 1 else None

    seen = wait_for("light", lit)
    after = wait_for(
        "a later status", lambda: s if (s := holod.status())["uptime_s"] > before["uptime_s"] + 1.5 else None
    )
    for name in ["frames_made", "frames_shown", "deadline_misses"]:
        assert before[name] <= value(seen[f"holod_{name}"], "_total") <= after[name], name
    samples = value(seen["holod_tracker_samples"], "_total")
    assert before["tracker_counts"]["samples"] <= samples <= after["tracker_counts"]["samples"]
    assert value(seen["holod_state"], **{"is": "running"}) == 1
    assert value(seen["holod_state"], **{"is": "dark"}) == 0
    assert sum(s.value for s in seen["holod_pupil_state"]) == 1
    assert 0.001 < value(seen["holod_pupil_diameter_meters"]) < 0.009
    [build] = seen["holod_build"]
    assert build.labels["hologram"] == "64x64" and build.labels["weights"] == "fast"
    light = seen["holod_sample_to_photon_seconds"]
    assert 0 < value(light, "_count") <= after["frames_shown"]
    assert value(light, "_sum") / value(light, "_count") > 0.001
    buckets = [s.value for s in light if s.name.endswith("_bucket")]
    assert buckets == sorted(buckets) and buckets[-1] == value(light, "_count")
    rejected = {s.labels["reason"]: s.value for s in seen["holod_tracker_rejected_samples"]}
    assert rejected.keys() == {
        name.removeprefix("rejected_") for name in after["tracker_counts"] if name.startswith("rejected_")
    }
    accepted = value(seen["holod_tracker_accepted_samples"], "_total")
    assert 0 < accepted + sum(rejected.values()) <= samples, rejected
    assert not any("rejected" in s.labels["event"] for s in seen["holod_tracker_events"])
    # The reading objects to what is no OpenMetrics.
    with pytest.raises(ValueError, match=r".+"):
        list(text_string_to_metric_families("# TYPE holod_x counter\nholod_x 1\n# EOF\n"))


def test_the_process_is_told_under_the_names_that_every_process_has(start: Start) -> None:
    holod = start()
    holod.status()
    seen = figures(holod)
    proc = Path(f"/proc/{holod.process.pid}")
    assert value(seen["process_resident_memory_bytes"]) > 1e6
    assert value(seen["process_virtual_memory_bytes"]) > value(seen["process_resident_memory_bytes"])
    assert abs(value(seen["process_threads"]) - len(list((proc / "task").iterdir()))) <= 2
    # Those of the question itself come and go.
    assert abs(value(seen["process_open_fds"]) - len(list((proc / "fd").iterdir()))) <= 4
    [limit] = [line.split() for line in (proc / "limits").read_text().splitlines() if line.startswith("Max open files")]
    assert value(seen["process_max_fds"]) == float(limit[3])
    assert abs(value(seen["process_start_time_seconds"]) - time.time()) < 600
    cpu_s = value(seen["process_cpu_seconds"], "_total")
    assert cpu_s > 0
    wait_for("it works on", lambda: value(figures(holod)["process_cpu_seconds"], "_total") > cpu_s)
    assert not any(name.startswith("holod_process") for name in seen)


def test_orders_that_are_refused_are_counted_by_reason(start: Start) -> None:
    holod = start()
    control = holod.status()["control"]

    def refused() -> dict[str, float]:
        return {s.labels["reason"]: s.value for s in figures(holod)["holod_control_refused"]}

    assert sum(refused().values()) == 0 and {"malformed", "impossible", "busy"} <= refused().keys()
    for line in [b'{"do":"dance"}\n', b"hello\n", b'{"do":"pupil","mm":99}\n']:
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(control)
            client.sendall(line)
            assert b'"error"' in client.recv(65536)
    wait_for("three are counted", lambda: sum(refused().values()) == 3)
    assert refused()["malformed"] == 2 and refused()["impossible"] == 1
    holod.ctl("pupil", "3")
    wait_for("it is taken", lambda: holod.status()["pupil_mm"] == 3)
    assert sum(refused().values()) == 3


def test_pictures_are_of_the_frame_and_the_eye_that_is_asked_for(start: Start) -> None:
    holod = start()
    holod.status()
    holod.ctl("pupil", "3")
    wait_for("the pupil is 3 mm", lambda: holod.status()["pupil_mm"] == 3)
    near, near_png = holod.get("/eye.png?focus_dpt=3")
    assert near.status == 200 and near_png.startswith(b"\x89PNG")
    assert float(near.getheader("holod-made-for-mm", "0")) == 3
    far, far_png = holod.get("/eye.png?focus_dpt=0&pupil_mm=6")
    assert float(far.getheader("holod-pupil-mm", "0")) == 6
    assert int(far.getheader("holod-frame", "0")) > int(near.getheader("holod-frame", "0"))
    assert near_png != far_png


def test_a_pattern_is_seen_in_place_of_the_hologram(start: Start) -> None:
    holod = start()
    holod.status()

    def brightness() -> tuple[float, float, float]:
        answer, png = holod.get("/eye.png?focus_dpt=0&pupil_mm=3")
        assert answer.status == 200, png
        pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)
        return tuple(pixels.mean(axis=(0, 1)))

    red, green, blue = brightness()
    assert 0.3 < green / red < 3 and 0.3 < green / blue < 3, "a hologram has all colours"
    holod.ctl("pattern", "cross-hair", "--line", "2", "--colour", "green")

    def lines_on_black() -> bool:
        red, green, blue = brightness()
        return green < 0.5 * min(red, blue)

    wait_for("green is black but for lines, red and blue are flat", lines_on_black)
    holod.ctl("hologram")
    wait_for("a hologram again", lambda: not lines_on_black())


@pytest.mark.parametrize(
    ("path", "status", "said"),
    [
        ("/eye.png?focus_dpt=NaN", 400, "focus_dpt: found NaN dpt, expected -1 to 20"),
        ("/eye.png?focus_dpt=99", 400, "focus_dpt: found 99 dpt"),
        ("/eye.png?pupil_mm=30", 400, "pupil_mm: found 30 mm, expected a human pupil"),
        ("/eye.png?focus=1", 400, "unknown field `focus`"),
        ("/eye.png?focus_dpt=near", 400, "invalid float"),
        ("/secret", 404, "there is no such page"),
        ("/../../etc/passwd", 404, "there is no such page"),
    ],
)
def test_what_cannot_be_answered_is_said(start: Start, path: str, status: int, said: str) -> None:
    answer, body = start().get(path)
    assert answer.status == status
    assert said in body.decode()


def test_the_page_is_for_this_machine_alone(start: Start) -> None:
    holod = start()
    answer, body = holod.get("/", Host="bench.example.org")
    assert answer.status == 421 and "expected localhost" in body.decode()
    policy = holod.get("/")[0].getheader("content-security-policy", "")
    assert policy.startswith("default-src 'self'") and "frame-ancestors 'none'" in policy
    connection = http.client.HTTPConnection("127.0.0.1", holod.port)
    connection.request("POST", "/", body="x")
    assert connection.getresponse().status == 405, "it only tells"


def test_a_token_opens_the_page_to_others(start: Start, tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text(f"{TOKEN}\n")
    token.chmod(0o600)
    holod = start("--page", "0.0.0.0:0", "--page-token", str(token))
    for headers in [{}, {"Authorization": "Bearer wrong"}, {"Cookie": "holod_token=wrong"}]:
        answer, body = holod.get("/status.json", **headers)
        assert answer.status == 401 and "--page-token" in body.decode()
    assert holod.get("/?token=wrong")[0].status == 401
    assert holod.get("/metrics", Authorization=f"Bearer {TOKEN}")[0].status == 200
    answer, _ = holod.get(f"/?token={TOKEN}")
    assert (answer.status, answer.getheader("location")) == (303, "/")
    cookie = answer.getheader("set-cookie", "")
    assert "HttpOnly" in cookie and "SameSite=Lax" in cookie
    answer, body = holod.get("/metrics", Cookie=cookie.split(";")[0])
    assert answer.status == 200 and b'holod_page_refused_total{reason="token"} 4\n' in body


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["--page", "0.0.0.0:0"], 64, "it needs a token: --page-token FILE"),
        (["--page", "bench:80"], 64, "expected a port such as 8420"),
        (["--page", "0", "--page-token", "{open}"], 78, "others may read it (mode 0644)"),
        (["--page", "0", "--page-token", "{none}"], 78, "No such file"),
        (["--page", "{taken}"], 69, "another program has the port"),
        (["--page", "unix:{open}"], 69, "a file that is no socket is there"),
    ],
)
def test_pages_that_cannot_be_are_refused_before_anything_starts(
    start: Start, tmp_path: Path, options: list[str], code: int, said: str
) -> None:
    holod = start()
    (tmp_path / "open").write_text(TOKEN)
    (tmp_path / "open").chmod(0o644)
    names = {"open": tmp_path / "open", "none": tmp_path / "none", "taken": holod.port}
    options = [option.format(**names) for option in options]
    ended = subprocess.run([holod.binary, "run", *options], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == code, ended.stderr
    assert said in ended.stderr
    assert (tmp_path / "open").read_text() == TOKEN


def test_a_unix_socket_serves_the_page_and_goes_with_the_run(start: Start, tmp_path: Path) -> None:
    path = tmp_path / "page"
    holod = start("--page", f"unix:{path}")
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
        client.sendall(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        said = b"".join(iter(lambda: client.recv(65536), b""))
    assert said.startswith(b"HTTP/1.1 200 OK") and b"holod_page_viewers 0" in said
    assert path.stat().st_mode & 0o777 == 0o660
    assert holod.end() == 0
    assert not path.exists()


def watch(port: int, seen: list[str]) -> None:
    """A viewer: the names of the events that it gets, or the status that refuses it, until there are no more."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", "/events")
    answer = connection.getresponse()
    if answer.status != 200:
        seen.append(str(answer.status))
        return
    while line := answer.readline():
        if line.startswith(b"event: "):
            seen.append(line.decode().split()[1])


def test_viewers_and_strangers_come_and_the_run_goes_on(start: Start) -> None:
    holod = start()
    frames_before = holod.status()["frames_shown"]
    seen: list[list[str]] = [[] for _ in range(100)]
    viewers = [threading.Thread(target=watch, args=(holod.port, each), daemon=True) for each in seen]
    for viewer in viewers:
        viewer.start()
    # Some say nothing, some never end what they say, some talk nonsense, some take nothing.
    strangers = [socket.create_connection(("127.0.0.1", holod.port)) for _ in range(60)]
    for number, stranger in enumerate(strangers):
        stranger.sendall(
            [
                b"",
                b"GET / HTTP/1.1\r\nX: ",
                b"\x00\xff" * 500 + b"\r\n\r\n",
                b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n",
            ][number % 4]
        )
    wait_for("64 viewers watch", lambda: sum("batch" in each for each in seen) >= 45)
    wait_for("the others are told", lambda: sum(each == ["503"] for each in seen) >= 20)
    # Connections are few: room is made where somebody goes.
    for stranger in strangers:
        stranger.close()
    wait_for("the page answers", lambda: holod.get("/")[0].status == 200)
    t_end = time.monotonic() + 2
    while time.monotonic() < t_end:
        holod.get("/metrics")
    assert holod.status()["frames_shown"] > frames_before + 20
    assert value(figures(holod)["holod_page_refused"], "_total", reason="viewers") >= 20
    assert holod.end() == 0
    for viewer in viewers:
        viewer.join(timeout=60)
    assert any(each[-1:] == ["end"] for each in seen), "viewers are told of the end"


def test_a_stream_begins_with_the_state_and_what_was(start: Start) -> None:
    holod = start()
    holod.status()
    connection = http.client.HTTPConnection("127.0.0.1", holod.port, timeout=60)
    connection.request("GET", "/events")
    answer = connection.getresponse()
    assert answer.getheader("content-type") == "text/event-stream"
    events = {}
    while not {"snapshot", "batch"} <= events.keys():
        name = answer.readline().decode().removeprefix("event: ").strip()
        events.setdefault(name, []).append(json.loads(answer.readline().decode().removeprefix("data: ")))
        assert answer.readline() == b"\n"
    assert events["snapshot"][0]["pid"] == holod.process.pid
    batches = events["batch"]
    while not any(batch["light"] for batch in batches):
        name, data, _ = (answer.readline().decode() for _ in range(3))
        if name.strip() == "event: batch":
            batches.append(json.loads(data.removeprefix("data: ")))
    # What is told of one frame agrees: woken, shown, lit.
    frames = {frame[0]: frame for batch in batches for frame in batch["frames"]}
    fields = [field for batch in batches for field in batch["fields"] if field[0] in frames]
    assert fields, batches
    for number, _, t_present, t_end, on, off, _ in fields:
        assert frames[number][1] < t_present < t_end
        assert frames[number][7] in (True, False)
        assert on is None or t_present < on < off < t_end
