"""Orders over a control socket whose other end is a test, as daemon/doc/control.md has it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

from holod_client import Control, ControlError, UnansweredError

Answer = Callable[[str], bytes | None]


def ok(do: str) -> bytes | None:
    return json.dumps({"ok": f"did {do}"}).encode() + b"\n"


class FakeControl:
    """Notes the orders of all connections, and answers each one as `answer` says: not at all with None, and with
    nothing (b"") by closing the connection."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.orders: list[str] = []
        self.requests: list[dict[str, str]] = []
        self.connections: list[socket.socket] = []
        self.answer: Answer = ok
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        self._accepts = threading.Thread(target=self._accept, daemon=True)
        self._accepts.start()

    def close(self) -> None:
        # Its thread ends first: it could go on with the next socket that has this one's number.
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._accepts.join()
        for one in (self._listener, *self.connections):
            one.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            self.connections.append(connection)
            threading.Thread(target=self._converse, args=(connection,), daemon=True).start()

    def _converse(self, connection: socket.socket) -> None:
        with connection, connection.makefile("rb") as lines, contextlib.suppress(OSError):
            for line in lines:
                self.requests.append(json.loads(line))
                do = self.requests[-1]["do"]
                self.orders.append(do)
                answer = self.answer(do)
                if answer == b"":
                    return
                if answer is not None:
                    connection.sendall(answer)


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[FakeControl]:
    running = FakeControl(tmp_path / "control-1")
    yield running
    running.close()


def test_orders_go_over_one_connection(fake: FakeControl) -> None:
    with Control(fake.path) as control:
        assert [control.pause(), control.resume()] == ["did pause", "did resume"]
    assert (fake.orders, len(fake.connections)) == (["pause", "resume"], 1)


def test_an_order_that_is_not_answered_may_have_taken_effect_and_the_next_has_its_own_answer(fake: FakeControl) -> None:
    with Control(fake.path, timeout_s=0.2) as control:
        fake.answer = lambda do: None
        with pytest.raises(UnansweredError, match=r"0\.2 s.*whether `scene` took effect is not known"):
            control.scene("feed")
        fake.answer = ok
        assert control.lasers_arm() == "did lasers-arm"
        assert control.status() == "did status"
    assert (fake.orders, len(fake.connections)) == (["scene", "lasers-arm", "status"], 2)


def test_an_order_that_holod_does_not_survive_may_have_taken_effect(fake: FakeControl) -> None:
    with Control(fake.path) as control:
        fake.answer = lambda do: b""
        with pytest.raises(UnansweredError, match=r"closed the connection.*whether `stop` took effect is not known"):
            control.stop()
        fake.close()
        fake.path.unlink()
        with pytest.raises(ControlError, match="no holod answers") as raised:
            control.lasers_arm()
        assert not isinstance(raised.value, UnansweredError)
    assert fake.orders == ["stop"]


def test_an_order_over_a_connection_that_holod_has_closed_is_not_given(fake: FakeControl) -> None:
    with Control(fake.path) as control:
        control.pause()
        fake.connections[0].shutdown(socket.SHUT_RDWR)
        with pytest.raises(ControlError, match="nothing has changed") as raised:
            control.resume()
        assert not isinstance(raised.value, UnansweredError)
        assert control.resume() == "did resume"
    assert fake.orders == ["pause", "resume"]


@pytest.mark.parametrize(
    "answer",
    [b"x" * (1 << 20) + b'\n{"ok": "of another"}\n', b"<html>\n", b"[]\n", b'{"okay": 1}\n', b'{"ok": "half'],
    ids=["too long", "no JSON", "no object", "another object", "cut off"],
)
def test_an_answer_that_is_none_is_no_answer(fake: FakeControl, answer: bytes) -> None:
    with Control(fake.path, timeout_s=0.5) as control:
        fake.answer = lambda do: answer
        with pytest.raises(UnansweredError, match="whether `pause` took effect is not known"):
            control.pause()
        fake.answer = ok
        assert control.resume() == "did resume"


def test_the_answer_to_an_order_that_was_interrupted_is_not_taken_for_the_next_ones(fake: FakeControl) -> None:
    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    go_on = threading.Event()

    def late(do: str) -> bytes | None:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)
        go_on.wait(10)
        return ok(do)

    before = signal.signal(signal.SIGUSR1, interrupt)
    try:
        with Control(fake.path) as control:
            fake.answer = late
            with pytest.raises(KeyboardInterrupt):
                control.weights("small")
            fake.answer = ok
            go_on.set()
            assert control.status() == "did status"
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_refusals_keep_the_connection(fake: FakeControl) -> None:
    with Control(fake.path) as control:
        fake.answer = lambda do: b'{"error": "no such scene"}\n'
        for _ in range(2):
            with pytest.raises(ControlError, match="no such scene") as raised:
                control.scene("feed")
            assert not isinstance(raised.value, UnansweredError)
    assert len(fake.connections) == 1


def test_what_a_holod_whose_control_thread_hangs_has_done_is_not_known(fake: FakeControl) -> None:
    with Control(fake.path) as control:
        fake.answer = lambda do: b'{"error": "the control thread does not answer", "unanswered": true}\n'
        with pytest.raises(UnansweredError, match="does not answer"):
            control.lasers_dark()
        fake.answer = ok
        assert control.status() == "did status"
    assert len(fake.connections) == 1


def test_a_pupil_may_be_a_number_of_numpys(fake: FakeControl) -> None:
    with Control(fake.path) as control:
        for mm in (np.float32(3.5), np.int64(4), None):
            control.pupil(mm)
    assert [request["mm"] for request in fake.requests] == [3.5, 4, None]


def test_a_closed_control_sends_nothing(fake: FakeControl) -> None:
    control = Control(fake.path)
    control.close()
    control.close()
    with pytest.raises(ControlError, match="closed"):
        control.lasers_arm()
    assert fake.orders == []


def test_orders_wait_as_long_as_those_of_the_command() -> None:
    assert Control.__init__.__defaults__ == (None, 120.0)


def test_a_holod_without_a_feed_is_found_beside_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holod_client.feed.SERVICE_PATH", tmp_path / "service" / "feed")
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    for folder in ("service", "holod"):
        (tmp_path / folder).mkdir()
    (tmp_path / "service" / "feed").touch()
    service = FakeControl(tmp_path / "service" / "control-2")
    with Control() as control:
        assert control.path == service.path
    own = FakeControl(tmp_path / "holod" / "control-1")
    with Control() as control:
        assert control.path == own.path
    own.close()
    service.close()


def test_a_folder_of_somebody_elses_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holod_client.feed.SERVICE_PATH", tmp_path / "service" / "feed")
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/dev/null")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    folder = tmp_path / f"holod-{os.getuid()}"
    folder.mkdir()
    own = FakeControl(folder / "control-1")
    Control().close()
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ControlError, match=f"no holod runs .*; nothing in {folder} is used, which is no folder of"):
        Control()
    own.close()


def test_a_service_that_this_user_may_not_open_is_told_from_one_that_does_not_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/dev/null")
    # Nobody else may look into pytest's own folders.
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        os.chmod(folder, 0o755)
        monkeypatch.setattr("holod_client.feed.SERVICE_PATH", Path(folder) / "feed")
        service = FakeControl(Path(folder) / "control-1")
        os.chmod(service.path, 0)
        # root may open everything.
        os.seteuid(os.getuid() or 65534)
        try:
            with pytest.raises(ControlError, match=f"may not open {service.path}: .* a member of its group"):
                Control()
        finally:
            os.seteuid(os.getuid())
            service.close()


def test_a_holod_that_lets_nobody_in_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "holod").mkdir()
    path = tmp_path / "holod" / "control-1"
    with contextlib.ExitStack() as closing:
        listener = closing.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        listener.bind(str(path))
        listener.listen(0)
        waiting = closing.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        waiting.connect(str(path))
        for named in (None, path):
            with pytest.raises(ControlError, match=f"nobody in on {path}: it hangs; `holod dark --config RIG`"):
                Control(named, timeout_s=0.2)


def test_a_place_at_the_socket_is_waited_for(tmp_path: Path) -> None:
    with contextlib.ExitStack() as closing:
        listener = closing.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        listener.bind(str(tmp_path / "control-1"))
        listener.listen(0)
        waiting = closing.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        waiting.connect(str(tmp_path / "control-1"))
        accepts = threading.Timer(0.2, lambda: closing.push(listener.accept()[0]))
        accepts.start()
        Control(tmp_path / "control-1").close()
        accepts.join()


def test_a_path_leads_where_it_does_here(fake: FakeControl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "pictures" / "here").mkdir(parents=True)
    (tmp_path / "pictures" / "cards").mkdir()
    (tmp_path / "link").symlink_to("pictures/here")
    monkeypatch.chdir(tmp_path)
    with Control(fake.path) as control:
        control.scene("link/../cards")
        control.scene("/a.png,link/../d.png")
        control.weights("link/../cards")
    named = [request.get("scene", request.get("weights")) for request in fake.requests]
    assert named == [f"{tmp_path}/link/../cards", f"/a.png,{tmp_path}/link/../d.png", f"{tmp_path}/link/../cards"]


def test_weights_of_a_name_are_the_built_in_ones(
    fake: FakeControl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ("standard", "small", "fast")
    for name in names:
        (tmp_path / name).touch()
    with Control(fake.path) as control:
        for name in (*names, "./small"):
            control.weights(name)
    assert [request["weights"] for request in fake.requests] == [*names, f"{tmp_path}/./small"]


def test_nobody_listens(tmp_path: Path) -> None:
    with pytest.raises(ControlError, match="is it running"):
        Control(tmp_path / "control-1")
    assert not os.listdir(tmp_path)
