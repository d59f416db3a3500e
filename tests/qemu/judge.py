"""Says whether the guest's results are what they must be: judge.py RESULT_LOG.

Exits with 1 and a line for each mismatch. Before it judges, it shows that it can refuse: each figure of a made-up result
that is right is made wrong in turn, and each time there must be a mismatch.
"""

import copy
import fnmatch
import json
import re
import sys
from pathlib import Path

REPORTS = 1000
PLUGS = 2
EYES = 2
REPORT_BYTES = 15


def sections(log: str) -> dict[str, list[str]]:
    """The lines of each section."""
    found: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in log.replace("\r", "").splitlines():
        if line.startswith("== "):
            lines = found.setdefault(line[3:], [])
        else:
            lines.append(line)
    return found


def parse(log: str) -> dict:
    """The figures in the log; raises where one cannot be read."""
    found = sections(log)
    refused = "\n".join(found["refused"])
    mode, name = found["node"]
    pattern = re.search(r'KERNELS=="([^"]*)"', refused)
    return {
        "absent": "\n".join(found["absent"]),
        "refused": refused,
        "node_mode": mode.split()[0],
        "rule_fits": pattern is not None and fnmatch.fnmatchcase(name, pattern[1]),
        "sent": [json.loads(line) for line in found["sent"]],
        "read": json.loads(found["read"][-1]),
    }


def mismatches(result: dict) -> list[str]:
    """What is not as it must be."""
    wrong = []

    def expect(what: str, found: object, expected: object) -> None:
        if found != expected:
            wrong.append(f"{what}: found {found}, expected {expected}")

    def expect_near(what: str, found: float, expected: float, tolerance: float) -> None:
        if not abs(found - expected) <= tolerance:
            wrong.append(f"{what}: found {found}, expected {expected} within {tolerance}")

    def expect_text(what: str, text: str, part: str) -> None:
        if part not in text:
            wrong.append(f"{what}: `{part}` is not in what was said:\n{text}")

    expect_text("without a tracker", result["absent"], "no HID device is 1209:0001")
    expect_text("without a tracker", result["absent"], "there is no HID device at all")
    expect("mode of the node", result["node_mode"], "crw-------")
    expect_text("as another user", result["refused"], "permission denied")
    expect_text("as another user", result["refused"], "/etc/udev/rules.d/61-holod-tracker-hid.rules")
    expect("the rule told fits the kernel's name of the device", result["rule_fits"], True)

    sent = result["sent"]
    expect("plugs", [plug["plug"] for plug in sent], list(range(1, PLUGS + 1)))
    expect("different nodes", len({plug["node"] for plug in sent}), PLUGS)
    for plug in sent:
        expect(f"reports sent in plug {plug['plug']}", plug["sent"], REPORTS)
        expect_near(f"milliseconds of plug {plug['plug']}", plug["took_ms"], REPORTS, 0.05 * REPORTS)

    read = result["read"]
    samples = REPORTS * PLUGS * EYES
    for name, expected in {
        "samples": samples,
        "bytes": REPORTS * PLUGS * REPORT_BYTES,
        "left": samples // EYES,
        "right": samples // EYES,
        "both": 0,
        "sequence_gaps": 0,
        "sequence_missing": 0,
        "sequence_repeats": 0,
        "sequence_restarts": 0,
        "clock_resets": 0,
        "connects": PLUGS,
        "disconnects": PLUGS - 1,
    }.items():
        expect(name, read[name], expected)
    expect("faults", {name: count for name, count in read.items() if name.startswith("wire_") and count}, {})
    expect_near("mean of the left eye, mm", read["left_mean_mm"], 4.0495, 0.0001)
    expect_near("mean of the right eye, mm", read["right_mean_mm"], 3.5495, 0.0001)
    return wrong


def right_result() -> dict:
    """A made-up result that is right."""
    read = dict.fromkeys(["sequence_gaps", "sequence_missing", "sequence_repeats", "sequence_restarts"], 0)
    read |= {"samples": 4000, "bytes": 30000, "left": 2000, "right": 2000, "both": 0, "clock_resets": 0}
    read |= {"connects": 2, "disconnects": 1, "wire_too_short": 0, "left_mean_mm": 4.0495, "right_mean_mm": 3.5495}
    return {
        "absent": "no HID device is 1209:0001; there is no HID device at all; plug the tracker in",
        "refused": "permission denied; write this line to /etc/udev/rules.d/61-holod-tracker-hid.rules:",
        "node_mode": "crw-------",
        "rule_fits": True,
        "sent": [{"plug": plug, "node": f"hidraw{plug}", "sent": 1000, "took_ms": 1000} for plug in (1, 2)],
        "read": read,
    }


def check_the_judge() -> list[str]:
    """The wrong results that were not refused."""
    failures = [f"a right result was refused: {wrong}" for wrong in mismatches(right_result())]

    def try_wrong(what: str, result: dict) -> None:
        if not mismatches(result):
            failures.append(f"a wrong result was not refused: {what}")

    for key, value in {"absent": "", "refused": "", "node_mode": "crw-rw----", "rule_fits": False, "sent": []}.items():
        try_wrong(key, right_result() | {key: value})
    for name, value in right_result()["read"].items():
        result = right_result()
        result["read"][name] = value + 1
        try_wrong(name, result)
    for name in ["plug", "sent", "node", "took_ms"]:
        result = copy.deepcopy(right_result())
        result["sent"][1][name] = result["sent"][0][name] if name in {"plug", "node"} else 900
        try_wrong(name, result)
    return failures


def main() -> int:
    """Judges the log that is named on the command line."""
    wrong = check_the_judge()
    try:
        wrong += mismatches(parse(Path(sys.argv[1]).read_text(errors="replace")))
    except (KeyError, IndexError, ValueError, TypeError) as error:
        wrong.append(f"the result cannot be read: {error!r}")
    for line in wrong:
        print(f"wrong: {line}")
    if not wrong:
        print(f"{PLUGS} times {REPORTS} reports at 1 kHz were read, over an unplug and a replug at another node")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
