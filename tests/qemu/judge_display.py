"""Says whether the display guest's results are what they must be: judge_display.py RESULT_LOG.

Exits with 1 and a line for each mismatch. Before it judges, it shows that it can refuse: each figure of a made-up result
that is right is made wrong in turn, and each time there must be a mismatch.
"""

import copy
import itertools
import json
import struct
import sys
import zlib
from pathlib import Path

PERIOD_US = 16667
INTERVAL_TOLERANCE_US = 100
# Refreshes of each run, and how many different pictures its patterns make.
RUNS = {"flips": (1003, 7), "fields": (303, 21), "monochrome": (103, 7)}
# Refreshes after the panel came back.
AFTER_LOSS = 120
# Where flips are not what is judged, a busy host may make the emulated machine late by one.
MISSED_AFTER_LOSS = 1
# Of the panel, each with a picture.
BUFFERS = 4
# Until the counter and times of flips have agreed three times.
BEFORE_BELIEVED = 2
CHECKS_READ_BACK = {
    "card opened by": "holod itself",
    "mode": "160 by 120 at 60.000 Hz, pixel clock 1500 kHz",
    "panel's own pixels (EDID)": "160 by 120",
    "pixels taken from the buffer": "160 by 120 from 0, 0",
    "pixels shown": "160 by 120 from 0, 0",
    "range of RGB (Broadcast RGB)": "Full",
    "bits of a channel on the link (max bpc)": "8",
    "gamma table (GAMMA_LUT)": "none",
    "cursor and overlay planes": "0",
    "clock of flip events": "monotonic",
    "refresh counter of driver `vkms`": "counts",
}
LOSSES = {
    "mastership": "another program took the display over",
    "seat": "the display was switched to another session",
    "seat_thief": "another program took the display over",
    "seat_manager": "the graphics device was lost",
    "unplug": "the panel was unplugged",
    "other_monitor": "the panel was unplugged",
    "unplug_and_removal": "the graphics device was lost",
    "removal": "the graphics device was lost",
}
# The seat manager takes mastership away before it says so, and with its own end before that is noticed: a flip may come
# between. A panel is unplugged before its card goes.
LOST_AT_FIRST = dict.fromkeys(["seat", "seat_manager"], "another program took the display over")
LOST_AT_FIRST["unplug_and_removal"] = "the panel was unplugged"
# Runs whose card a seat manager opens, for a user who may not.
SEATED = ["seat", "seat_thief", "seat_manager"]
# Runs during which another terminal was in front: without a seat manager nothing is lost.
SWITCHED = ["terminal", "seat", "daemon"]
# A master is made to let go of the card's one descriptor.
THEFTS = ["mastership", "seat_thief"]
REFUSALS = {
    "no_such_connector": ["no connector and no monitor is `DP-9`", "Virtual-1 on /dev/dri/card0", "HOLOD TEST"],
    "other_size": ["has 160 by 120 pixels", "the rig says 640 by 480"],
    "other_rate": ["at 75.000 Hz", "it offers: 160 by 120 at 60.000 Hz"],
    "other_master": ["another program is master of /dev/dri/card0: drm_panel (process "],
    "no_seat": ["/dev/dri/card0 does not open: permission denied"],
    "no_permission": ["/dev/dri/card0 does not open: permission denied", "group `video` (mode 0660)", "62-holod-panel.rules"],
    "disconnected": ["Virtual-1 on /dev/dri/card0 is disconnected", "Plug the panel in"],
}
# What holod says of the panel, and of a run through a seat manager with another terminal in front for a while.
CHECK_SAYS = [
    "ok   lasers     /tmp/lasers: simulated, dark, interlock closed",
    "ok   panel      drm:Virtual-1: 160x120 at 60 Hz, as the rig says; the flat pattern came on it",
    "ok   panel      card opened by: seat `seat0`",
    "ok   panel      mode: 160 by 120 at 60.000 Hz",
    "ok   panel      range of RGB (Broadcast RGB): Full, wanted Full (right)",
    "ok   panel      refresh counter of driver `vkms`: counts",
]
DAEMON_SAYS = [
    "the panel is lost, lasers dark: the display was switched to another session",
    "the panel is back",
    "stopping: SIGTERM",
]
DAEMON_TELLS = {
    "exit": 0,
    "ended_by": "SIGTERM",
    "lasers_dark_at_end": True,
    "flat_at_end": True,
    "box_armed": 2,
    "box_last": "dark shutdown",
    "shows_at_end": "allocated by = [fbcon]",
}
PIXELS = 160 * 120
# Of frames that are 40 ms apart in the third of a second that is watched.
HOLOGRAMS_MIN = 5


def parse(log: str) -> dict:
    """Each section: its exit code, and what its lines of JSON hold; raises where one cannot be read."""
    sections: dict[str, dict] = {}
    section: dict = {}
    for line in log.replace("\r", "").splitlines():
        if line.startswith("== "):
            section = sections.setdefault(line[3:], {"back": 0, "said": ""})
        elif line.startswith("exit "):
            section["exit"] = int(line[5:])
        elif line.startswith("{"):
            found = json.loads(line)
            section["back"] += int("back_t_ms" in found)
            section |= found
        else:
            section["said"] += line + "\n"
    return sections


def flat_sums() -> list[str]:
    """vkms's check sums of every picture of the panel that has one level."""
    pixels = (struct.pack("<4H", 0xFFFF, *[level * 257] * 3) for level in range(256))
    return [f"{zlib.crc32(pixel * PIXELS, 0xFFFFFFFF) ^ 0xFFFFFFFF:#010x}" for pixel in pixels]


FLAT_SUMS = flat_sums()


def daemon_mismatches(run: dict, check: dict) -> list[str]:
    """What is not as it must be of holod itself."""
    wrong = [f"daemon: `{said}` was not said" for said in DAEMON_SAYS if said not in run["said"]]
    wrong += [f"daemon_check: `{said}` was not said" for said in CHECK_SAYS if said not in check["said"]]
    if check["exit"] != 0:
        wrong.append(f"daemon_check: exit {check['exit']}")
    for key, expected in DAEMON_TELLS.items():
        if run[key] != expected:
            wrong.append(f"daemon: {key}: found {run[key]}, expected {expected}")
    lasers = run["lasers"]
    if lasers["unsafe_findings"] != 0 or "panel-lost" not in str(lasers["went_dark"]):
        wrong.append(f"daemon: lasers: {lasers}")
    lit_by = {key: count for key, count in run.items() if key.startswith("lit_by_")}
    if lit_by != {"lit_by_hardware": lasers["lit"]}:
        wrong.append(f"daemon: {lasers['lit']} fields were lit, by the panel's times {lit_by}")
    # Fields that were planned when the panel was lost are not lit any more.
    if run["box_on"] != run["box_off"] or not lasers["lit"] - 3 <= run["box_on"] <= lasers["lit"]:
        wrong.append(f"daemon: the box lit {run['box_on']} of {lasers['lit']} fields, and ended {run['box_off']}")
    if not 60 <= run["lit_before"] == run["lit_after"] < run["box_on"]:
        wrong.append(f"daemon: lit with another terminal in front: {run['lit_before']} to {run['lit_after']} times")
    pictures = [crc for crc, _ in itertools.groupby(crc for crc in run["scanned_out"] if crc)]
    flat = next((index for index, crc in enumerate(pictures) if crc in FLAT_SUMS), 0)
    holograms, afterwards = set(pictures[:flat]), pictures[flat + 1 :]
    # A pupil may come back to where it was, and its hologram with it; sooner it is one out of another buffer.
    again = any(crc in pictures[max(0, index - BUFFERS) : index] for index, crc in enumerate(pictures[:flat]))
    # After the flat pattern only the console comes.
    if len(holograms) < HOLOGRAMS_MIN or again or holograms & set(afterwards) or len(afterwards) > 2:
        wrong.append(f"daemon: scanned out: {pictures}")
    return wrong


def mismatches(result: dict) -> list[str]:
    """What is not as it must be."""
    wrong = []

    def expect(what: str, found: object, expected: object) -> None:
        if found != expected:
            wrong.append(f"{what}: found {found}, expected {expected}")

    def expect_clean(name: str, run: dict, refreshes: int, believed: int, missed_most: int = 0) -> None:
        expect(f"{name}: exit", run["exit"], 0)
        expect(f"{name}: refreshes", run["refreshes"], refreshes)
        expect(f"{name}: before they are believed", run["before_believed"], BEFORE_BELIEVED)
        expect(f"{name}: hardware times", run["hardware"], believed)
        for fault in [
            "repeated",
            "not_the_next_field_of_the_next_frame",
            "reported_before_their_time",
            "allocations_in_tick",
        ]:
            expect(f"{name}: {fault}", run[fault], 0)
        missed = run["not_counted_on_by_one"]
        if missed > missed_most:
            wrong.append(f"{name}: not_counted_on_by_one: found {missed}, expected at most {missed_most}")
        # One that is missed makes one interval of two refreshes.
        for interval_us, expected_us in zip(run["interval_us"], [PERIOD_US, PERIOD_US * (1 + min(missed, 1))], strict=True):
            if not abs(interval_us - expected_us) <= INTERVAL_TOLERANCE_US:
                wrong.append(f"{name}: an interval of {interval_us} us")

    for name, (refreshes, patterns) in RUNS.items():
        run = result[name]
        believed = refreshes - BEFORE_BELIEVED
        expect_clean(name, run, refreshes, believed)
        sums = run["crc"]
        expect(f"{name}: different patterns", sums["patterns"], patterns)
        expect(f"{name}: pictures that are not those that were meant", sums["different"], 0)
        # The check sums begin a little after the panel.
        if not sums["equal"] >= believed - 5:
            wrong.append(f"{name}: only {sums['equal']} pictures were compared")
        expect(f"{name}: wrong checks", run["wrong"], 0)
        checks = {name: (found, verdict) for name, found, _, verdict in run["checks"]}
        for check, found in CHECKS_READ_BACK.items():
            expect(f"{name}: {check}", checks.get(check), (found, "right"))
    for name, said in LOSSES.items():
        run = result[name]
        expect_clean(name, run, AFTER_LOSS, AFTER_LOSS - BEFORE_BELIEVED, MISSED_AFTER_LOSS)
        expect(f"{name}: times that it came back", run["back"], 1)
        for word, words in {"lost": [said, LOST_AT_FIRST.get(name, said)], "not_yet": [said]}.items():
            if not any(said in run[word] for said in words):
                wrong.append(f"{name}: none of {words} is in `{run[word]}`")
    for name in SEATED:
        expect(f"{name}: card opened by", opened_by(result[name]), "seat `seat0`")
    expect("not_seated: exit", result["not_seated"]["exit"], 0)
    expect("not_seated: card opened by", opened_by(result["not_seated"]), "holod itself")
    expect_clean("terminal", result["terminal"], AFTER_LOSS, AFTER_LOSS - BEFORE_BELIEVED, MISSED_AFTER_LOSS)
    expect("terminal: times that it came back", result["terminal"]["back"], 0)
    for name in SWITCHED:
        expect(f"{name}: terminals in front", result[f"terminals_of_{name}"]["terminals"], "tty2 tty1")
    expect("another user of the card, of another terminal: exit", result["user"]["exit"], 0)
    for name in THEFTS:
        theft = result[f"thief_of_{name}"]
        expect(f"{name}: descriptors of the card that were taken", theft["taken"], 1)
        expect(f"thief of {name}: exit", theft["exit"], 0)
    for name, parts in REFUSALS.items():
        expect(f"{name}: exit", result[name]["exit"], 1)
        for part in parts:
            if part not in result[name]["refused"]:
                wrong.append(f"{name}: `{part}` is not in `{result[name]['refused']}`")
    wrong.extend(daemon_mismatches(result["daemon"], result["daemon_check"]))
    # The program's own comparison can fail, too.
    if not result["wrong_level"]["crc"]["different"] >= 5:
        wrong.append(f"another level in one pattern of seven went unseen: {result['wrong_level']['crc']}")
    if not result["wrong_submission"]["repeated"] >= 2:
        wrong.append(f"frames that were left out went unseen: {result['wrong_submission']}")
    return wrong


def opened_by(run: dict) -> str:
    """Who opened the card, by the panel's own word."""
    return next(found for name, found, _, _ in run["checks"] if name == "card opened by")


def right_run(refreshes: int) -> dict:
    """What a run without a fault tells."""
    run = {"exit": 0, "back": 0, "refreshes": refreshes, "before_believed": 2, "hardware": refreshes - 2}
    for fault in ["repeated", "not_counted_on_by_one", "not_the_next_field_of_the_next_frame"]:
        run[fault] = 0
    run |= {"reported_before_their_time": 0, "allocations_in_tick": 0, "interval_us": [16666, 16668], "wrong": 0}
    run["checks"] = [[name, found, found, "right"] for name, found in CHECKS_READ_BACK.items()]
    return run


MISSED_ONE = {"not_counted_on_by_one": 1, "interval_us": [16666, 33334]}
RIGHT_HOLOGRAMS = ["a", "b", "c", "d", "e"]


def right_result() -> dict:
    """A made-up result that is right."""
    result = {}
    for name, (refreshes, patterns) in RUNS.items():
        crc = {"equal": refreshes - 4, "different": 0, "missing": 2, "patterns": patterns}
        result[name] = right_run(refreshes) | {"crc": crc}
    for name, said in LOSSES.items():
        result[name] = right_run(AFTER_LOSS) | {"back": 1, "lost": said, "not_yet": said}
    for name in SEATED:
        result[name]["checks"] = [["card opened by", "seat `seat0`", "", "right"]]
    result["not_seated"] = {"exit": 0, "checks": [["card opened by", "holod itself", "", "right"]]}
    result["terminal"] = right_run(AFTER_LOSS)
    for name in SWITCHED:
        result[f"terminals_of_{name}"] = {"terminals": "tty2 tty1"}
    result["user"] = {"exit": 0}
    for name in THEFTS:
        result[f"thief_of_{name}"] = {"taken": 1, "exit": 0}
    for name, parts in REFUSALS.items():
        result[name] = {"exit": 1, "refused": " ".join(parts)}
    result["daemon_check"] = {"exit": 0, "said": "\n".join(CHECK_SAYS)}
    result["daemon"] = DAEMON_TELLS | {
        "said": "\n".join(DAEMON_SAYS),
        "lasers": {"lit": 155, "unsafe_findings": 0, "went_dark": ["panel-lost at 1 ns", "shutdown at 2 ns"]},
        "lit_by_hardware": 155,
        "lit_before": 60,
        "lit_after": 60,
        "box_on": 154,
        "box_off": 154,
        "scanned_out": [*RIGHT_HOLOGRAMS, *RIGHT_HOLOGRAMS[-1:], *FLAT_SUMS[:1] * 3, "console", ""],
    }
    result["wrong_level"] = {"crc": {"equal": 50, "different": 8}}
    result["wrong_submission"] = {"repeated": 4}
    return result


def check_the_judge() -> list[str]:
    """The wrong results that were not refused."""
    once_late = right_result()
    for section in [*LOSSES, "terminal"]:
        once_late[section] |= MISSED_ONE
    back_again = right_result()
    back_again["daemon"]["scanned_out"] = [*RIGHT_HOLOGRAMS, "a", FLAT_SUMS[0]]
    right = [right_result(), once_late, back_again]
    failures = [f"a right result was refused: {wrong}" for wrong in itertools.chain(*map(mismatches, right))]

    def try_wrong(what: str, change) -> None:
        result = copy.deepcopy(right_result())
        change(result)
        if not mismatches(result):
            failures.append(f"a wrong result was not refused: {what}")

    def put(section: str, key: str, value: object):
        return lambda result: result[section].__setitem__(key, value)

    for section in [*RUNS, *LOSSES, "terminal"]:
        for key in ["exit", "refreshes", "before_believed", "hardware", "repeated", "allocations_in_tick"]:
            try_wrong(f"{section} {key}", put(section, key, 1))
        for key in ["not_counted_on_by_one", "not_the_next_field_of_the_next_frame", "reported_before_their_time"]:
            try_wrong(f"{section} {key}", put(section, key, 1))
        for interval in [[16500, 16667], [16667, 33334]]:
            try_wrong(f"{section} interval", put(section, "interval_us", interval))
        try_wrong(f"{section} two missed", lambda result, s=section: result[s].update(MISSED_ONE, not_counted_on_by_one=2))
    for section in RUNS:
        try_wrong(f"{section} one missed", lambda result, s=section: result[s].update(MISSED_ONE))
        try_wrong(f"{section} wrong", put(section, "wrong", 1))
        for key, value in {"equal": 20, "different": 1, "patterns": 1}.items():
            try_wrong(f"{section} {key}", lambda result, s=section, k=key, v=value: result[s]["crc"].__setitem__(k, v))
        for index in range(len(CHECKS_READ_BACK)):
            for place, word in {1: "other", 3: "unverified"}.items():

                def change(result: dict, s: str = section, i: int = index, p: int = place, w: str = word) -> None:
                    result[s]["checks"][i][p] = w

                try_wrong(f"{section} check {index}", change)
    for section in LOSSES:
        try_wrong(f"{section} back", put(section, "back", 0))
        for key in ["lost", "not_yet"]:
            try_wrong(f"{section} {key}", put(section, key, "something else"))
    for section in SEATED:
        try_wrong(f"{section} opened by", put(section, "checks", right_result()["not_seated"]["checks"]))
    try_wrong("not_seated exit", put("not_seated", "exit", 1))
    try_wrong("not_seated opened by", put("not_seated", "checks", right_result()["seat"]["checks"]))
    try_wrong("terminal back", put("terminal", "back", 1))
    for section in SWITCHED:
        try_wrong(f"{section} terminals", put(f"terminals_of_{section}", "terminals", "tty1 tty1"))
    try_wrong("user exit", put("user", "exit", 1))
    for section in THEFTS:
        for key, value in {"taken": 0, "exit": 1}.items():
            try_wrong(f"thief of {section} {key}", put(f"thief_of_{section}", key, value))
    for section in REFUSALS:
        try_wrong(f"{section} exit", put(section, "exit", 0))
        try_wrong(f"{section} refused", put(section, "refused", "no"))
    for section, parts in {"daemon": DAEMON_SAYS, "daemon_check": CHECK_SAYS}.items():
        for part in parts:
            try_wrong(f"{section} says {part}", put(section, "said", right_result()[section]["said"].replace(part, "")))
    try_wrong("daemon_check exit", put("daemon_check", "exit", 1))
    for key in DAEMON_TELLS:
        try_wrong(f"daemon {key}", put("daemon", key, "other"))
    for key, value in {"lit": 170, "unsafe_findings": 1, "went_dark": ["shutdown at 2 ns"]}.items():
        try_wrong(f"daemon lasers {key}", lambda result, k=key, v=value: result["daemon"]["lasers"].__setitem__(k, v))
    try_wrong("daemon lit by others", put("daemon", "lit_by_software", 3))
    for key, value in {"lit_by_hardware": 154, "lit_after": 61, "box_on": 155, "box_off": 153}.items():
        try_wrong(f"daemon {key}", put("daemon", key, value))
    try_wrong("daemon unlit", lambda result: result["daemon"].update(lit_before=0, lit_after=0))
    flat = FLAT_SUMS[0]
    for name, sums in {
        "flat only": [flat] * 9,
        "no flat": RIGHT_HOLOGRAMS,
        "one hologram": ["a", "b", "c", "d", "a", flat],
        "few holograms": [*RIGHT_HOLOGRAMS[1:], flat],
        "a hologram out of another buffer": [*RIGHT_HOLOGRAMS, "b", flat],
        "a hologram at the end": [*RIGHT_HOLOGRAMS, flat, "e"],
        "more after the flat pattern": [*RIGHT_HOLOGRAMS, flat, "x", "y", "z"],
    }.items():
        try_wrong(f"daemon scanned out {name}", put("daemon", "scanned_out", sums))
    try_wrong("wrong_level", put("wrong_level", "crc", {"different": 0}))
    try_wrong("wrong_submission", put("wrong_submission", "repeated", 0))
    return failures


def main() -> int:
    """Judges the log that is named on the command line."""
    wrong = check_the_judge()
    try:
        result = parse(Path(sys.argv[1]).read_text(errors="replace"))
        wrong += mismatches(result)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        wrong.append(f"the result cannot be read: {error!r}")
    for line in wrong:
        print(f"wrong: {line}")
    if not wrong:
        flips = result["flips"]
        print(
            f"{flips['hardware']} flips, none missed or doubled, {flips['crc']['equal']} pictures as they were meant; "
            f"fields and monochrome too; mastership, terminal, seat, monitor and card lost and back; "
            f"{len(REFUSALS)} wrong wishes refused; holod lit {result['daemon']['box_on']} fields and none in the background"
        )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
