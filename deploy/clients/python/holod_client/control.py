"""Changes a running holod, as `holod ctl` does."""

from __future__ import annotations

import errno
import glob
import json
import os
import socket
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from holod_client import feed
from holod_client.folders import is_own, own_folders, warning_of

LONGEST_ANSWER_BYTES = 1 << 20
# How long others may be before this one at the socket, as for `holod ctl`.
CONNECTS_WITHIN_S = 3.0
# Orders for which holod reads files or draws; to the others it answers within 5 s even where its control thread hangs.
TAKES_LONG = ("scene", "weights", "reload", "pattern", "flat")
ANSWERS_WITHIN_S = 8.0
BUILT_IN_WEIGHTS = ("standard", "small", "fast")


class ControlError(Exception):
    """holod is not there, or refuses the order; nothing has changed then, but that a holod which refuses
    `lasers_dark()`, since its laser box does not acknowledge it, lights nothing more.

    An `UnansweredError`, which is one of these, is the exception: what holod has done is not known.
    """


class UnansweredError(ControlError):
    """holod has the order, but its answer did not come, or is that it hangs. Whether the order took effect, or still
    will, is not known: the lasers may be lit. Of `lasers_dark()` the words say what is known."""


class Control:
    """A connection to the control socket of a running holod, for orders one after the other.

    `path` is the socket; without one it is that of the only holod in this user's runtime folder, or else of the
    service. An order waits for holod up to `timeout_s` seconds, which may be changed at any time: weights and long
    sequences take a while to read. One for which holod reads no file waits for 8 s at most.

    An order whose answer does not come raises UnansweredError. It may have taken effect, and where holod hangs it may
    take effect later, even after orders that are given meanwhile: ask for the `status()` before relying on either. The
    connection is closed then, and so it is where a call is interrupted; the next order opens another one to the same
    socket, so that no answer is taken for that of another order. Nothing is sent twice by itself.

    One of these must not be used by two threads at the same time.

    Raises ControlError where no holod is found, or several are.
    """

    def __init__(self, path: str | os.PathLike[str] | None = None, timeout_s: float = 120.0) -> None:
        self.path = _only_socket() if path is None else Path(path)
        self.timeout_s = timeout_s
        self._is_closed = False
        self._socket: socket.socket | None = None
        self._answers: BinaryIO | None = None
        self._connected()

    def ask(self, do: str, **details: Any) -> Any:
        """Gives the order `do` of daemon/doc/control.md, and returns the answer.

        Raises UnansweredError where it is not known whether it took effect, else ControlError.
        """
        request = json.dumps({"do": do, **details}).encode() + b"\n"
        connection, answers = self._connected()
        timeout_s = self.timeout_s if do in TAKES_LONG else min(self.timeout_s, ANSWERS_WITHIN_S)
        connection.settimeout(timeout_s)
        try:
            try:
                # What raises here has left out the end of the line at least, without which holod does nothing.
                connection.sendall(request)
            except OSError as error:
                raise ControlError(
                    f"{self.path} takes no order ({_why(error)}), and nothing has changed: does that holod still run?"
                ) from error
            answer = self._answer(do, answers, timeout_s)
        except BaseException:
            self._disconnect()
            raise
        if "error" in answer:
            raise (UnansweredError if answer.get("unanswered") else ControlError)(answer["error"])
        return answer["ok"]

    def status(self) -> dict[str, Any]:
        """How the run is at this moment, as `holod status --json` prints it."""
        return self.ask("status")

    def scene(self, scene: str | os.PathLike[str], depth_encoding: str | None = None, fit: str = "native") -> str:
        """Shows another scene (a folder, or "COLOUR,DEPTH"), or the live feed again ("feed").

        `depth_encoding` is for "COLOUR,DEPTH": a folder's scene.toml names its own."""
        named = os.fspath(scene)
        if named != "feed":
            parts = [named] if os.path.exists(named) else named.split(",")
            named = ",".join(map(_whole_path, parts))
        details = {} if depth_encoding is None else {"depth_encoding": depth_encoding}
        return self.ask("scene", scene=named, fit=fit, **details)

    def weights(self, weights: str | os.PathLike[str]) -> str:
        """Computes with other weights: "standard", "small", "fast", or a file ("./small" where it has such a name)."""
        named = os.fspath(weights)
        is_file = named not in BUILT_IN_WEIGHTS and os.path.exists(named)
        return self.ask("weights", weights=_whole_path(named) if is_file else named)

    def pause(self) -> str:
        """Lets the picture stand still; the pupil is followed."""
        return self.ask("pause")

    def resume(self) -> str:
        """Lets it go on."""
        return self.ask("resume")

    def pupil(self, mm: float | None) -> str:
        """Computes for one pupil, in millimetres, whatever the tracker says; None follows the tracker again."""
        return self.ask("pupil", mm=None if mm is None else float(mm))

    def eye(self, eye: str) -> str:
        """Follows another eye: "left", "right", "both" (their mean) or "better" (of which the tracker is surer)."""
        return self.ask("eye", eye=eye)

    def reload(self) -> str:
        """Has the rig file read again. Raises ControlError, and nothing changes, where that needs a restart."""
        return self.ask("reload")

    def flat(self) -> str:
        """Shows one phase everywhere in place of holograms."""
        return self.ask("flat")

    def pattern(
        self, kind: str, axis_px: tuple[float, float] = (0, 0), colours: Sequence[str] = (), **figures: Any
    ) -> str:
        """Shows a test pattern in place of holograms, such as pattern("grating", period_px=8, profile="blazed").

        Kinds and figures are those of daemon/doc/control.md, lengths in metres: pattern("lens", focal_length_m=0.3).
        The status says in words which one is shown. `axis_px` is the optical axis right and up of the panel's centre;
        `colours` that are not named are flat, and all have the pattern where none is.
        """
        return self.ask("pattern", pattern={"kind": kind, **figures}, axis_px=list(axis_px), colours=list(colours))

    def hologram(self) -> str:
        """Shows holograms again."""
        return self.ask("hologram")

    def lasers_dark(self) -> str:
        """Keeps the lasers dark. Raises ControlError where the box does not acknowledge that: look at the lasers.

        Where holod's control thread hangs, the lasers are put out beside it, and UnansweredError says whether the box
        acknowledged. Where holod hangs as a whole, or is not there, `holod dark --config RIG` puts them out."""
        return self.ask("lasers-dark")

    def lasers_arm(self) -> str:
        """Lets the lasers be lit by the rules again."""
        return self.ask("lasers-arm")

    def stop(self) -> str:
        """Ends the run in order."""
        return self.ask("stop")

    def close(self) -> None:
        """May be called again."""
        self._is_closed = True
        self._disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _connected(self) -> tuple[socket.socket, BinaryIO]:
        """The connection, which is opened where there is none."""
        if self._is_closed:
            raise ControlError(f"this connection to {self.path} was closed; nothing has changed")
        if self._socket is None or self._answers is None:
            try:
                connection = _connect(self.path, self.timeout_s)
            except OSError as error:
                raise ControlError(_why_not_connected(self.path, error)) from error
            self._socket, self._answers = connection, connection.makefile("rb")
        return self._socket, self._answers

    def _disconnect(self) -> None:
        for one in (self._answers, self._socket):
            if one is not None:
                one.close()
        self._socket = self._answers = None

    def _answer(self, do: str, answers: BinaryIO, timeout_s: float) -> dict[str, Any]:
        def unanswered(what: str) -> UnansweredError:
            return UnansweredError(f"{what}; whether `{do}` took effect is not known: see its status and its log")

        try:
            line = answers.readline(LONGEST_ANSWER_BYTES)
        except TimeoutError as error:
            raise unanswered(f"holod has not answered on {self.path} for {timeout_s:g} s") from error
        except OSError as error:
            raise unanswered(f"holod does not answer on {self.path}: {_why(error)}") from error
        if len(line) == LONGEST_ANSWER_BYTES:
            raise unanswered(f"the answer on {self.path} is longer than {LONGEST_ANSWER_BYTES} bytes")
        if not line.endswith(b"\n"):
            raise unanswered(f"holod closed the connection on {self.path}")
        try:
            answer = json.loads(line)
        except ValueError as error:
            raise unanswered(f"{self.path} answered {line[:40]!r}, which is no JSON: is it holod?") from error
        if not isinstance(answer, dict) or not ("ok" in answer or "error" in answer):
            raise unanswered(f"{self.path} answered {line[:40]!r}, expected `ok` or `error`: is it holod?")
        return answer


def _connect(path: Path, timeout_s: float) -> socket.socket:
    """A connection. Where others are before this one it is tried again for 3 s at most."""
    given_up_s = time.monotonic() + min(timeout_s, CONNECTS_WITHIN_S)
    while True:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.settimeout(timeout_s)
        try:
            connection.connect(str(path))
            return connection
        except BlockingIOError:
            connection.close()
            if time.monotonic() > given_up_s:
                raise
            time.sleep(0.02)
        except BaseException:
            connection.close()
            raise


def _why(error: OSError) -> str:
    return error.strerror or str(error)


def _why_not_connected(path: Path, error: OSError) -> str:
    if error.errno == errno.EACCES:
        return f"this user may not open {path}: run as the user that holod runs as, or as a member of its group"
    if isinstance(error, BlockingIOError | TimeoutError):
        return f"holod lets nobody in on {path}: it hangs; `holod dark --config RIG` puts the lasers out beside it"
    return f"no holod answers on {path}: {_why(error)}; is it running?"


def _whole_path(path: str) -> str:
    """From the root. It keeps `..`, which leads elsewhere behind a symbolic link than its text says."""
    return os.path.join(os.getcwd(), path)


def _is_of_living(path: str) -> bool:
    """Whether there is more than the socket of a holod that was killed: also one that hangs, or that this user may not
    open, of which `_connected` says so."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as trial:
        trial.setblocking(False)
        return trial.connect_ex(path) in (0, errno.EAGAIN, errno.EACCES)


def _only_socket() -> Path:
    folders, service = own_folders(), feed.SERVICE_PATH.parent
    for folder in (*folders, service):
        if folder != service and not is_own(folder):
            # In the folder for temporary files anybody could have made one of this user's name first.
            continue
        found = [path for path in sorted(glob.glob(glob.escape(str(folder)) + "/control-*")) if _is_of_living(path)]
        if len(found) > 1:
            raise ControlError(f"several holods run: {', '.join(found)}; give the path of one")
        if found:
            return Path(found[0])
    places = " or ".join(map(str, (*folders, service)))
    warnings = "".join(warning_of(folder) for folder in folders if folder != service)
    raise ControlError(f"no holod runs that has a control socket in {places}: start it, or give the path{warnings}")
