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
# Of each eye the least diameter: it rises by a micrometre a report and falls back after a hundred.
EYES_MM = {"left": 4.0, "right": 3.5}
REPORT_BYTES = 15
NO_EYE = {
    "samples": 0,
    "raw_mm": dict.fromkeys(["p1", "median", "p99", "max"], 0),
    "interval_ms": {"median": 0},
    "rate_hz": 0,
}


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
        "read": json.loads("\n".join(found["read"])),
        "sent_by_usage": [json.loads(line) for line in found["sent_by_usage"]],
        "read_by_usage": json.loads("\n".join(found["read_by_usage"])),
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

    # Once by the places that the profile names, over a replug; once by usages, which the kernel hands on.
    for run, plugs in {"": PLUGS, "_by_usage": 1}.items():
        sent, read = result[f"sent{run}"], result[f"read{run}"]
        expect(f"plugs{run}", [plug["plug"] for plug in sent], list(range(1, plugs + 1)))
        expect(f"different nodes{run}", len({plug["node"] for plug in sent}), plugs)
        for plug in sent:
            expect(f"reports sent in plug {plug['plug']}{run}", plug["sent"], REPORTS)
            expect_near(f"milliseconds of plug {plug['plug']}{run}", plug["took_ms"], REPORTS, 0.05 * REPORTS)
        counts, eyes = read["counts"], read["eyes"]
        for name, expected in {
            "samples": REPORTS * plugs * len(EYES_MM),
            "bytes": REPORTS * plugs * REPORT_BYTES,
            "sequence_gaps": 0,
            "sequence_missing": 0,
            "sequence_repeats": 0,
            "sequence_restarts": 0,
            "clock_resets": 0,
            "connects": plugs,
            "disconnects": plugs - 1,
        }.items():
            expect(f"{name}{run}", counts[name], expected)
        faults = {name: count for name, count in counts.items() if name.startswith("wire_") and count}
        expect(f"faults{run}", faults, {})
        expect(f"eyes{run}", sorted(eyes), sorted(EYES_MM))
        for name, least_mm in EYES_MM.items():
            eye = eyes.get(name, NO_EYE)
            expect(f"samples of the {name} eye{run}", eye["samples"], REPORTS * plugs)
            for quantile, rise_mm in {"p1": 0.001, "median": 0.05, "p99": 0.098, "max": 0.099}.items():
                found_mm = eye["raw_mm"][quantile]
                expect_near(f"{quantile} of the {name} eye{run}, mm", found_mm, least_mm + rise_mm, 0.0015)
            expect_near(f"interval of the {name} eye{run}, ms", eye["interval_ms"]["median"], 1.0, 0.05)
            # Over a replug there is a gap.
            if plugs == 1:
                expect_near(f"rate of the {name} eye{run}, Hz", eye["rate_hz"], 1000.0, 20.0)
    return wrong


def right_result() -> dict:
    """A made-up result that is right."""
    result = {
        "absent": "no HID device is 1209:0001; there is no HID device at all; plug the tracker in",
        "refused": "permission denied; write this line to /etc/udev/rules.d/61-holod-tracker-hid.rules:",
        "node_mode": "crw-------",
        "rule_fits": True,
    }
    for run, plugs in {"": 2, "_by_usage": 1}.items():
        sent = [{"plug": plug + 1, "node": f"hidraw{plug}", "sent": 1000, "took_ms": 1000} for plug in range(plugs)]
        result |= {f"sent{run}": sent, f"read{run}": right_counts(plugs)}
    return result


def right_counts(plugs: int) -> dict:
    """What a reader counts that reads all of so many plugs."""
    counts = dict.fromkeys(["sequence_gaps", "sequence_missing", "sequence_repeats", "sequence_restarts"], 0)
    counts |= {"samples": 2000 * plugs, "bytes": 15000 * plugs, "clock_resets": 0, "wire_too_short": 0}
    counts |= {"connects": plugs, "disconnects": plugs - 1}
    eyes = {}
    for name, least_mm in EYES_MM.items():
        raw_mm = {"p1": least_mm + 0.001, "median": least_mm + 0.05, "p99": least_mm + 0.098, "max": least_mm + 0.099}
        eyes[name] = {"samples": 1000 * plugs, "raw_mm": raw_mm, "interval_ms": {"median": 1.0}, "rate_hz": 1000.0}
    return {"counts": counts, "eyes": eyes}


def paths_of(table: dict) -> list[list[str]]:
    """The keys that lead to each number in nested tables."""
    paths = []
    for key, value in table.items():
        below = paths_of(value) if isinstance(value, dict) else [[]]
        paths += [[key, *path] for path in below]
    return paths


def check_the_judge() -> list[str]:
    """The wrong results that were not refused."""
    failures = [f"a right result was refused: {wrong}" for wrong in mismatches(right_result())]

    def try_wrong(what: str, result: dict) -> None:
        if not mismatches(result):
            failures.append(f"a wrong result was not refused: {what}")

    for key, value in {"absent": "", "refused": "", "node_mode": "crw-rw----", "rule_fits": False, "sent": []}.items():
        try_wrong(key, right_result() | {key: value})
    for name in ["read", "read_by_usage"]:
        for path in paths_of(right_result()[name]):
            # Of several plugs the rate is not judged.
            if path[-1] == "rate_hz" and name == "read":
                continue
            result = right_result()
            table = result[name]
            for key in path[:-1]:
                table = table[key]
            table[path[-1]] = 2 * table[path[-1]] + 1
            try_wrong(f"{name} {path}", result)
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
        print(
            f"{PLUGS} times {REPORTS} reports at 1 kHz were read, over a replug at another node, and {REPORTS} by usage"
        )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
