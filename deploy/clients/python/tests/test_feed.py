"""Every byte that a feed sends, and everything that holod may answer."""

from __future__ import annotations

import dataclasses
import gc
import logging
import os
import re
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fake_holod import NOT_SHOWN, OVERTAKEN, REFUSED, TAKEN, FakeHolod, Hello, Layout, ObjectionError

import holod_client
from holod_client import Colour, Depth, Feed, FeedError, FeedTimeoutError, Outcomes
from holod_client.folders import own_folders

WIDTH, HEIGHT = 21, 10
NUMBERS = {"rgba8": 1, "rgba16f": 2, "rgb32f": 3}
DEPTH_NUMBERS = {"none": 0, "u16_mm": 1, "f16_m": 2, "f16_dpt": 3, "f32_m": 4, "f32_dpt": 5}


def picture(seed: int, colour: str = "rgba8", depth: str = "u16_mm") -> tuple[np.ndarray, np.ndarray | None]:
    random = np.random.default_rng(seed)
    shape = (3, HEIGHT, WIDTH) if colour == "rgb32f" else (HEIGHT, WIDTH, 4)
    dtype = {"rgba8": np.uint8, "rgba16f": np.float16, "rgb32f": np.float32}[colour]
    light = (random.random(shape) * (255 if colour == "rgba8" else 1)).astype(dtype)
    if depth == "none":
        return light, None
    dtype = {"u16": np.uint16, "f16": np.float16, "f32": np.float32}[depth[:3]]
    return light, (random.random((HEIGHT, WIDTH)) * (60000 if depth == "u16_mm" else 4)).astype(dtype)


def open_feed(path: Path, **changes: object) -> Feed:
    options: dict = {"depth": "u16_mm", "path": path, "timeout_s": 5.0, **changes}
    return Feed(WIDTH, HEIGHT, **options)


@pytest.mark.parametrize("depth", DEPTH_NUMBERS)
@pytest.mark.parametrize("colour", NUMBERS)
def test_every_format_arrives_byte_for_byte(path: Path, colour: str, depth: str) -> None:
    plane = 1.25 if depth == "none" else None
    with FakeHolod(path) as holod:
        feed = open_feed(path, colour=colour, depth=depth, plane_dpt=plane, name="Kamera")
        assert holod.hello() == Hello(WIDTH, HEIGHT, NUMBERS[colour], DEPTH_NUMBERS[depth], plane or 0, "Kamera")
        for seed in range(7):
            light, mm = picture(seed, colour, depth)
            feed.send(light, mm, t_capture_ns=seed)
            frame = holod.frame()
            frame.check(light.tobytes(), b"" if mm is None else mm.tobytes())
            assert (frame.sequence, frame.t_capture_ns) == (seed + 1, seed)
            holod.free(frame)
        feed.wait()
        assert feed.outcomes == Outcomes(sent=7, taken=7)
        feed.close()


def test_the_check_of_a_picture_objects_to_one_wrong_byte(path: Path) -> None:
    with FakeHolod(path) as holod, open_feed(path) as feed:
        light, mm = picture(0)
        feed.send(light, mm)
        frame = holod.frame()
        for label, at in (("colour", 0), ("colour", light.nbytes - 1), ("depth", 0), ("depth", mm.nbytes - 1)):
            planes = {"colour": bytearray(light.tobytes()), "depth": bytearray(mm.tobytes())}
            planes[label][at] ^= 1
            with pytest.raises(ObjectionError, match=f"{label}, byte {at}: found"):
                frame.check(bytes(planes["colour"]), bytes(planes["depth"]))
        with pytest.raises(ObjectionError, match="bytes, expected"):
            frame.check(light.tobytes(), mm.tobytes()[:-1])
        holod.free(frame)


@pytest.mark.parametrize("slots", [1, 2, 5])
def test_any_number_of_slots(path: Path, slots: int) -> None:
    with FakeHolod(path, slots=slots) as holod, open_feed(path) as feed:
        for _ in range(3):
            pictures = [picture(seed) for seed in range(slots)]
            for light, mm in pictures:
                feed.send(light, mm)
            frames = [holod.frame() for _ in pictures]
            assert sorted(frame.slot for frame in frames) == list(range(slots))
            for frame, (light, mm) in zip(frames, pictures, strict=True):
                frame.check(light.tobytes(), mm.tobytes())
            for frame in reversed(frames):
                holod.free(frame)


@pytest.mark.parametrize("colour", ["rgba8", "rgba16f"])
def test_three_channels_do(path: Path, colour: str) -> None:
    light, mm = picture(0, colour)
    with FakeHolod(path) as holod, open_feed(path, colour=colour) as feed:
        feed.send(light[..., :3], mm)
        frame = holod.frame()
        arrived = np.frombuffer(frame.colour, light.dtype).reshape(light.shape)
        np.testing.assert_array_equal(arrived[..., :3], light[..., :3])
        holod.free(frame)


def test_a_slot_is_written_without_a_copy(path: Path) -> None:
    light, mm = picture(0)
    with FakeHolod(path) as holod, open_feed(path) as feed:
        with feed.slot() as slot:
            assert slot.colour.shape == (HEIGHT, WIDTH, 4) and slot.depth.shape == (HEIGHT, WIDTH)
            slot.colour[...] = light
            slot.depth[...] = mm
            slot.t_capture_ns = 77
        frame = holod.frame()
        frame.check(light.tobytes(), mm.tobytes())
        assert frame.t_capture_ns == 77
        with pytest.raises(ValueError, match="read-only"):
            slot.colour[...] = 0
        with pytest.raises(ValueError, match="read-only"):
            slot.depth[...] = 0
        holod.free(frame)


@pytest.mark.parametrize("part", ["colour", "depth"])
def test_an_array_in_the_place_of_a_slots_own_is_not_sent_and_left_as_it_was(path: Path, part: str) -> None:
    light, mm = picture(0)
    array = {"colour": light, "depth": mm}[part]
    with FakeHolod(path, slots=1) as holod, open_feed(path) as feed:
        with pytest.raises(ValueError, match=rf"{part}: .*slot\.{part}\[\.\.\.\] = "), feed.slot() as slot:
            own = getattr(slot, part)
            setattr(slot, part, array)
        assert array.flags.writeable and not own.flags.writeable
        assert feed.outcomes.sent == 0
        feed.send(light, mm)
        holod.free(holod.frame())


def test_the_end_of_a_feed_is_seen_though_a_forked_program_has_its_socket(path: Path) -> None:
    with FakeHolod(path) as holod:
        feed = open_feed(path)
        assert feed._socket is not None
        with feed._socket.dup():
            feed.send(*picture(0))
            feed.close()
            holod.frame()
            holod.wait_for_the_end()


def test_after_the_last_number_a_feed_has_none(path: Path) -> None:
    with FakeHolod(path, slots=1) as holod, open_feed(path) as feed:
        feed.leave_out(2**64 - 2)
        feed.send(*picture(0))
        frame = holod.frame()
        assert frame.sequence == 2**64 - 1
        holod.free(frame)
        with pytest.raises(FeedError, match="no numbers left"):
            feed.send(*picture(0))


def test_a_picture_whose_block_raises_is_not_sent(path: Path) -> None:
    with FakeHolod(path, slots=1) as holod, open_feed(path) as feed:
        with pytest.raises(ZeroDivisionError), feed.slot():
            _ = 1 // 0
        assert feed.outcomes.sent == 0
        feed.send(*picture(1))
        holod.free(holod.frame())


def test_two_slots_at_a_time(path: Path) -> None:
    with FakeHolod(path) as holod, open_feed(path) as feed:
        with feed.slot() as outer:
            outer.colour[...] = 1
            with feed.slot() as inner:
                inner.colour[...] = 2
        frames = holod.frame(), holod.frame()
        assert [set(frame.colour) for frame in frames] == [{2}, {1}]
        for frame in frames:
            holod.free(frame)


def test_pictures_left_out_show_in_the_sequence(path: Path) -> None:
    with FakeHolod(path) as holod, open_feed(path) as feed:
        feed.send(*picture(0))
        feed.leave_out()
        feed.leave_out(4)
        feed.send(*picture(1))
        frames = [holod.frame(), holod.frame()]
        assert [frame.sequence for frame in frames] == [1, 7]
        for frame in frames:
            holod.free(frame)


def test_waits_for_a_slot(path: Path) -> None:
    with FakeHolod(path) as holod, open_feed(path) as feed:
        for seed in range(3):
            feed.send(*picture(seed))
        frames = [holod.frame() for _ in range(3)]
        threading.Timer(0.2, holod.free, (frames[1],)).start()
        began = time.monotonic()
        light, mm = picture(3)
        feed.send(light, mm)
        assert time.monotonic() - began > 0.15
        late = holod.frame()
        assert late.slot == frames[1].slot
        late.check(light.tobytes(), mm.tobytes())
        for frame in (frames[0], frames[2], late):
            holod.free(frame)


@pytest.mark.parametrize("timeout_s", [0, 0.1])
def test_a_slow_holod_is_a_timeout_and_no_end(path: Path, timeout_s: float) -> None:
    with FakeHolod(path) as holod, open_feed(path, timeout_s=timeout_s) as feed:
        for seed in range(3):
            feed.send(*picture(seed))
        with pytest.raises(FeedTimeoutError, match="kept all 3 slots") as raised:
            feed.send(*picture(3))
        assert isinstance(raised.value, TimeoutError)
        with pytest.raises(FeedTimeoutError, match="3 pictures"):
            feed.wait()
        frames = [holod.frame() for _ in range(3)]
        for frame in frames:
            holod.free(frame)
        feed.send(*picture(3))
        frame = holod.frame()
        assert frame.sequence == 4
        feed.timeout_s = None
        holod.free(frame)


def test_what_became_of_pictures(path: Path) -> None:
    outcomes = [TAKEN, OVERTAKEN, OVERTAKEN, REFUSED, REFUSED, REFUSED, NOT_SHOWN, NOT_SHOWN, NOT_SHOWN, NOT_SHOWN]
    with FakeHolod(path) as holod, open_feed(path) as feed:
        for seed, outcome in enumerate(outcomes):
            feed.send(*picture(seed))
            holod.free(holod.frame(), outcome)
        feed.wait()
        assert feed.outcomes == Outcomes(sent=10, taken=1, overtaken=2, refused=3, not_shown=4)
        assert feed.outcomes.unknown == 0
        assert str(feed.outcomes) == ("10 sent: 1 taken, 2 overtaken, 3 refused, 4 while another client was shown")


def test_a_refusal_is_told_and_the_feed_goes_on(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with FakeHolod(path) as holod, open_feed(path) as feed, caplog.at_level(logging.WARNING):
        for text in ("no pixel has a depth: gefüllt mit 0", "no pixel has a depth: gefüllt mit 0", "another", None):
            feed.send(*picture(0))
            holod.free(holod.frame(), TAKEN if text is None else REFUSED, text or "")
            feed.wait()
            assert feed.refusal == (text or "another")
        assert feed.outcomes == Outcomes(sent=4, taken=1, refused=3)
        assert [record.getMessage() for record in caplog.records] == [
            "holod refused a picture: no pixel has a depth: gefüllt mit 0",
            "holod refused a picture: another",
        ]


def test_holod_refuses_the_format(path: Path) -> None:
    with (
        FakeHolod(path, nope="found a width of 9000 pixels, expected at most 7680"),
        pytest.raises(FeedError, match=r"refused the connection on .*: found a width of 9000 pixels"),
    ):
        open_feed(path)


def test_holod_refuses_in_the_middle_with_pictures_unread(path: Path) -> None:
    with FakeHolod(path) as holod:
        feed = open_feed(path)
        feed.send(*picture(0))
        feed.send(*picture(1))
        holod.refuse("a message of 3 bytes, expected 40")
        with pytest.raises(FeedError, match="a message of 3 bytes"):
            feed.wait()
        with pytest.raises(FeedError, match="a message of 3 bytes"):
            feed.send(*picture(2))


def test_holod_refuses_between_the_beginning_and_the_end_of_a_slot(path: Path) -> None:
    with FakeHolod(path) as holod:
        feed = open_feed(path)
        with pytest.raises(FeedError, match="found slot 7"), feed.slot() as slot:
            holod.refuse("found slot 7")
        assert slot.colour.sum() == 0


def test_holod_dies_in_the_middle(path: Path) -> None:
    with FakeHolod(path) as holod:
        feed = open_feed(path)
        feed.send(*picture(0))
        holod.free(holod.frame())
        holod.die()
        with pytest.raises(FeedError, match="holod closed the connection"):
            feed.send(*picture(1))
        assert feed.outcomes == Outcomes(sent=1, taken=1)


def test_holod_dies_while_a_context_waits(path: Path) -> None:
    with FakeHolod(path) as holod, pytest.raises(FeedError, match="closed the connection"), open_feed(path) as feed:
        feed.send(*picture(0))
        holod.die()


def test_a_context_that_raises_does_not_wait(path: Path) -> None:
    with FakeHolod(path), pytest.raises(ZeroDivisionError), open_feed(path, timeout_s=None) as feed:
        feed.send(*picture(0))
        _ = 1 // 0


def test_holod_says_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holod_client.feed.ANSWER_TIMEOUT_S", 0.1)
    with FakeHolod(path, silent=True), pytest.raises(FeedTimeoutError, match="said nothing"):
        open_feed(path)


def test_nobody_listens(path: Path) -> None:
    advice = "start it with `holod run --scene feed`"
    with pytest.raises(FeedError, match=f"no holod listens on {path}: {advice}"):
        open_feed(path)
    leave_behind(path)
    with pytest.raises(FeedError, match=advice):
        open_feed(path)


def leave_behind(path: Path) -> Path:
    """What a holod that was killed leaves: a socket on which nobody listens."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left_behind:
        left_behind.bind(str(path))
    return path


@pytest.mark.parametrize("is_left_behind", [True, False])
def test_the_service_is_found_behind_a_socket_that_was_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_left_behind: bool
) -> None:
    service = tmp_path / "service" / "feed"
    service.parent.mkdir()
    monkeypatch.setattr("holod_client.feed.SERVICE_PATH", service)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    own = tmp_path / "holod" / "feed"
    if is_left_behind:
        leave_behind(own)
    with FakeHolod(service) as holod, Feed(WIDTH, HEIGHT, depth="u16_mm") as feed:
        assert feed.path == service
        feed.send(*picture(0))
        holod.free(holod.frame())
    with pytest.raises(FeedError, match=f"no holod listens on {own} or .*{service}: start it with"):
        Feed(WIDTH, HEIGHT, depth="u16_mm")
    # A path that was named is the one that is meant.
    named = leave_behind(tmp_path / "named")
    with FakeHolod(service) as holod:
        with pytest.raises(FeedError, match=f"no holod listens on {named}: start it with"):
            open_feed(named)
        Feed(WIDTH, HEIGHT, depth="u16_mm").close()


def test_a_holod_of_ones_own_goes_before_the_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holod_client.feed.SERVICE_PATH", tmp_path / "service")
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "holod").mkdir()
    own = tmp_path / "holod" / "feed"
    with FakeHolod(tmp_path / "service"), FakeHolod(own):
        feed = Feed(WIDTH, HEIGHT, depth="u16_mm")
        assert feed.path == own
        feed.close()
        open_feed(tmp_path / "service").close()


def test_another_program_listens(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(FeedError, match="SOCK_SEQPACKET"):
            open_feed(path)


def test_a_path_too_long_for_a_socket(tmp_path: Path) -> None:
    with pytest.raises(FeedError, match="path too long"):
        open_feed(tmp_path / ("x" * 120))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda ring: dataclasses.replace(ring, slots=0), "0 slots"),
        (lambda ring: dataclasses.replace(ring, colour_bytes=1), "1 bytes of colour"),
        (lambda ring: dataclasses.replace(ring, depth_bytes=7), "7 bytes of depth"),
        (lambda ring: dataclasses.replace(ring, colour_offset=ring.colour_offset + 4), "not multiples"),
        (lambda ring: dataclasses.replace(ring, depth_offset=ring.distance), "outside"),
        (lambda ring: dataclasses.replace(ring, slots=4), "cannot map"),
    ],
)
def test_memory_that_does_not_fit(path: Path, change: Callable[[Layout], Layout], expected: str) -> None:
    with FakeHolod(path, change=change), pytest.raises(FeedError, match=expected):
        open_feed(path)


def test_messages_of_another_protocol(path: Path) -> None:
    with FakeHolod(path) as holod:
        feed = open_feed(path)
        holod.hello()
        holod.connection.send(b"WHAT is this")
        with pytest.raises(FeedError, match="'WHAT' of 12 bytes, expected FREE"):
            feed.send(*picture(0))


def test_a_slot_that_holod_did_not_have(path: Path) -> None:
    with FakeHolod(path) as holod:
        feed = open_feed(path)
        feed.send(*picture(0))
        frame = holod.frame()
        holod.free(frame)
        with pytest.raises(FeedError, match=f"slot {frame.slot}"), feed.slot(), feed.slot(), feed.slot():
            holod.free(frame)
            feed.wait()


@pytest.mark.parametrize(
    ("colour", "depth", "error", "expected"),
    [
        (np.zeros((HEIGHT, WIDTH, 4), np.float32), np.zeros((HEIGHT, WIDTH), np.uint16), TypeError, "colour: found fl"),
        (np.zeros((WIDTH, HEIGHT, 4), np.uint8), np.zeros((HEIGHT, WIDTH), np.uint16), ValueError, "colour: found sh"),
        (np.zeros((HEIGHT, WIDTH, 1), np.uint8), np.zeros((HEIGHT, WIDTH), np.uint16), ValueError, "colour: found sh"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), np.zeros((HEIGHT, WIDTH), np.float32), TypeError, "depth: found fl"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), np.zeros((HEIGHT, WIDTH), np.int16), TypeError, "expected uint16"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), np.zeros((HEIGHT, 1), np.uint16), ValueError, "depth: found sh"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), None, ValueError, "depth: found none"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), [[1]], TypeError, "depth: found list"),
    ],
)
def test_nothing_is_converted(
    path: Path, colour: np.ndarray, depth: np.ndarray, error: type[Exception], expected: str
) -> None:
    with FakeHolod(path), open_feed(path) as feed:
        with pytest.raises(error, match=expected):
            feed.send(colour, depth)
        assert feed.outcomes.sent == 0


@pytest.mark.parametrize(
    ("depth", "advice"),
    [
        ("u16_mm", "filled(0)"),
        ("f16_m", "filled(np.nan)"),
        ("f32_m", "filled(np.nan)"),
        ("f16_dpt", "filled(np.nan)"),
        ("f32_dpt", "filled(np.nan)"),
    ],
)
def test_a_mask_is_not_lost(path: Path, depth: str, advice: str) -> None:
    light, far = picture(0, depth=depth)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[2, 3] = True
    masked = np.ma.masked_array(far, mask)
    with FakeHolod(path, slots=1) as holod, open_feed(path, depth=depth, timeout_s=0.5) as feed:
        said = f"depth: found a masked array, expected one without a mask, such as its {advice}, which is no depth"
        with pytest.raises(TypeError, match=re.escape(said)):
            feed.send(light, masked)
        said = "colour: found a masked array, expected one without a mask, such as its filled(0), which is black"
        with pytest.raises(TypeError, match=re.escape(said)):
            feed.send(np.ma.masked_array(light), far)
        feed.send(light, masked.filled(0 if depth == "u16_mm" else np.nan))
        frame = holod.frame()
        assert not np.frombuffer(frame.depth, far.dtype).reshape(far.shape)[2, 3] > 0
        holod.free(frame)


def test_planes_of_floats_have_their_channels_first(path: Path) -> None:
    with FakeHolod(path), open_feed(path, colour="rgb32f") as feed, pytest.raises(ValueError, match=r"expected \(3,"):
        feed.send(np.zeros((HEIGHT, WIDTH, 3), np.float32), np.zeros((HEIGHT, WIDTH), np.uint16))


def test_depth_for_a_feed_without(path: Path) -> None:
    with (
        FakeHolod(path),
        open_feed(path, depth="none", plane_dpt=1) as feed,
        pytest.raises(ValueError, match="expected none"),
    ):
        feed.send(*picture(0))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"colour": "bgr8"}, "colour: found 'bgr8', expected one of rgba8, rgba16f, rgb32f"),
        ({"depth": "mm"}, "depth: found 'mm', expected one of none, u16_mm"),
        ({"depth": "none"}, "plane_dpt: found None"),
        ({"plane_dpt": 1.0}, "plane_dpt: found 1.0"),
    ],
)
def test_formats_that_are_none(path: Path, changes: dict, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        open_feed(path, **changes)


def test_sizes_that_are_none(path: Path) -> None:
    with pytest.raises(ValueError, match="height_px: found 0"):
        Feed(640, 0, depth="u16_mm", path=path)
    with pytest.raises(TypeError, match=r"width_px: found 640.0 \(float\), expected a whole number"):
        Feed(640.0, 480, depth="u16_mm", path=path)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("", ""),
        ("a" * 32, "a" * 32),
        ("a" * 33, "a" * 32),
        ("a" * 31 + "ü", "a" * 31),
        ("a" * 30 + "ü!", "a" * 30 + "ü"),
        ("a" * 29 + "眼鏡", "a" * 29 + "眼"),
        ("a" * 30 + "眼鏡", "a" * 30),
        ("🔴" * 9, "🔴" * 8),
    ],
)
def test_a_long_name_is_cut_between_characters(path: Path, name: str, expected: str) -> None:
    with FakeHolod(path) as holod, open_feed(path, name=name):
        assert holod.hello().name == expected


def test_no_descriptor_is_left_and_none_is_inherited(path: Path) -> None:
    def descriptors() -> set[int]:
        return {int(name) for name in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{name}")}

    gc.collect()
    before = descriptors()
    with FakeHolod(path):
        feed = open_feed(path)
        assert not [one for one in descriptors() - before if os.get_inheritable(one)]
        feed.close()
        feed.close()
    with FakeHolod(path, change=lambda ring: dataclasses.replace(ring, slots=0)), pytest.raises(FeedError):
        open_feed(path)
    with FakeHolod(path, nope="no"), pytest.raises(FeedError):
        open_feed(path)
    gc.collect()
    assert descriptors() == before


def test_a_closed_feed_says_so(path: Path) -> None:
    with FakeHolod(path):
        feed = open_feed(path)
        feed.close()
        with pytest.raises(FeedError, match="closed"):
            feed.send(*picture(0))


def test_a_slot_outlives_its_feed(path: Path) -> None:
    with FakeHolod(path):
        feed = open_feed(path)
        with pytest.raises(FeedError, match="closed"), feed.slot() as slot:
            feed.close()
            slot.colour[...] = 3
        assert slot.colour.min() == 3


def test_where_holod_listens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holod_client.feed.SERVICE_PATH", tmp_path / "service" / "feed")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "runtime"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "xdg"))
    assert holod_client.default_path() == tmp_path / "runtime" / "feed"
    monkeypatch.delenv("RUNTIME_DIRECTORY")
    assert holod_client.default_path() == tmp_path / "xdg" / "holod" / "feed"
    (tmp_path / "service").mkdir()
    (tmp_path / "service" / "feed").touch()
    assert holod_client.default_path() == tmp_path / "service" / "feed"
    (tmp_path / "xdg" / "holod").mkdir(parents=True)
    (tmp_path / "xdg" / "holod" / "feed").touch()
    assert holod_client.default_path() == tmp_path / "xdg" / "holod" / "feed"
    (tmp_path / "service" / "feed").unlink()
    uid = os.getuid()
    for none in ["", "relative"]:
        monkeypatch.setenv("RUNTIME_DIRECTORY", none)
        monkeypatch.setenv("XDG_RUNTIME_DIR", none)
        for temporary in ["/tmp", str(tmp_path)]:
            monkeypatch.setenv("TMPDIR", temporary)
            folder = f"/run/user/{uid}/holod" if os.path.isdir(f"/run/user/{uid}") else f"{temporary}/holod-{uid}"
            assert holod_client.default_path() == Path(folder) / "feed"
    monkeypatch.delenv("TMPDIR")
    assert own_folders()[-1] == Path(f"/tmp/holod-{uid}")


def test_holod_is_found_in_the_folder_for_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it has no folder of its own elsewhere, or may not write there."""
    monkeypatch.setattr("holod_client.feed.SERVICE_PATH", tmp_path / "service" / "feed")
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/dev/null")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    folder = tmp_path / f"holod-{os.getuid()}"
    folder.mkdir()
    with FakeHolod(folder / "feed"):
        assert holod_client.default_path() == folder / "feed"
        Feed(WIDTH, HEIGHT, depth="u16_mm").close()


@pytest.mark.parametrize("is_link", [True, False])
def test_a_folder_of_somebody_elses_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_link: bool) -> None:
    service = tmp_path / "service" / "feed"
    service.parent.mkdir()
    monkeypatch.setattr("holod_client.feed.SERVICE_PATH", service)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/dev/null")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    folder = tmp_path / f"holod-{os.getuid()}"
    if is_link:
        (tmp_path / "elsewhere").mkdir()
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        folder.mkdir()
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    trap = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    trap.bind(str(folder / "feed"))
    trap.listen()
    with trap, FakeHolod(service) as holod:
        assert holod_client.default_path() == service
        feed = Feed(WIDTH, HEIGHT, depth="u16_mm")
        assert feed.path == service
        holod.hello()
        feed.close()
        trap.setblocking(False)
        with pytest.raises(BlockingIOError):
            trap.accept()
    with pytest.raises(FeedError, match=f"no holod listens on .*; nothing in {folder} is used, which is no folder of"):
        Feed(WIDTH, HEIGHT, depth="u16_mm")


@pytest.mark.parametrize(
    ("t_capture_ns", "error", "expected"),
    [
        (1.5e9, TypeError, "t_capture_ns: found 1500000000.0 (float), expected whole nanoseconds"),
        ("now", TypeError, "t_capture_ns: found 'now' (str), expected whole nanoseconds"),
        (2**63, ValueError, f"t_capture_ns: found {2**63}, expected 0 to {2**63 - 1}"),
        (np.uint64(2**64 - 1), ValueError, f"t_capture_ns: found {2**64 - 1}, expected"),
        (-1, ValueError, "t_capture_ns: found -1, expected 0"),
    ],
)
def test_times_that_are_none_cost_no_slot(
    path: Path, t_capture_ns: object, error: type[Exception], expected: str
) -> None:
    with FakeHolod(path, slots=1) as holod, open_feed(path, timeout_s=0.5) as feed:
        for _ in range(2):
            with pytest.raises(error, match=re.escape(expected)):
                feed.send(*picture(0), t_capture_ns=t_capture_ns)
            with pytest.raises(error, match=re.escape(expected)), feed.slot() as slot:
                slot.t_capture_ns = t_capture_ns
        assert feed.outcomes.sent == 0
        feed.send(*picture(1), t_capture_ns=np.int64(77))
        frame = holod.frame()
        assert frame.t_capture_ns == 77
        holod.free(frame)


@pytest.mark.parametrize(
    ("pictures", "error", "expected"),
    [
        (1.0, TypeError, "pictures: found 1.0 (float), expected a whole number"),
        (-1, ValueError, "pictures: found -1, expected 0 or more"),
        (2**64, ValueError, f"pictures: found {2**64}, expected 0 or more, and fewer than"),
    ],
)
def test_pictures_left_out_that_are_no_number_cost_no_slot(
    path: Path, pictures: object, error: type[Exception], expected: str
) -> None:
    with FakeHolod(path, slots=1) as holod, open_feed(path, timeout_s=0.5) as feed:
        with pytest.raises(error, match=re.escape(expected)):
            feed.leave_out(pictures)
        feed.send(*picture(1))
        frame = holod.frame()
        assert frame.sequence == 1
        holod.free(frame)


def test_formats_have_the_names_that_they_are_given_by() -> None:
    assert list(Colour) == list(NUMBERS)
    assert list(Depth) == list(DEPTH_NUMBERS)


def test_a_picture_says_how_it_was_taken(path: Path) -> None:
    colour = np.zeros((2, 4, 4), np.uint8)
    with FakeHolod(path) as holod:
        holod.serve()
        with Feed(4, 2, depth="none", plane_dpt=1.0, path=path, tells_view=True) as feed:
            feed.send(colour, focus_dpt=1.25, field_of_view_deg=(60.0, 45.5))
            feed.send(colour, focus_dpt=0.0)
            feed.send(colour)
            feed.send(colour, focus_dpt=np.float32(0.5), field_of_view_deg=np.array([30.0, 20.0]))
            for view, said in [
                ({"focus_dpt": 20.5}, "found 20.5, expected 0"),
                ({"focus_dpt": float("nan")}, "found nan"),
                ({"field_of_view_deg": (60.0, 180.0)}, "expected two angles"),
                ({"field_of_view_deg": (60.0,)}, "expected two angles"),
            ]:
                with pytest.raises(ValueError, match=said):
                    feed.send(colour, **view)
            feed.wait()
            assert feed.outcomes.sent == 4, "what is wrong is not sent, and the slot stays"
        frames = holod.served()
    assert holod.hello().version == 2
    views = [(frame.focus_dpt, frame.field_of_view_deg) for frame in frames]
    assert views == [(1.25, (60.0, 45.5)), (0.0, None), (None, None), (0.5, (30.0, 20.0))]


def test_a_feed_that_tells_no_view_is_of_version_1(path: Path) -> None:
    with FakeHolod(path) as holod:
        holod.serve()
        with Feed(4, 2, depth="none", plane_dpt=1.0, path=path) as feed:
            with pytest.raises(ValueError, match="expected a feed that was opened with tells_view"):
                feed.send(np.zeros((2, 4, 4), np.uint8), focus_dpt=1.0)
            feed.send(np.zeros((2, 4, 4), np.uint8))
        assert len(holod.served()) == 1
    assert holod.hello().version == 1
