"""The page in a real browser: what a person sees of a run."""

from __future__ import annotations

import base64
import http.client
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import PATIENCE_S, Holod, wait_for
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

Start = Callable[..., Holod]
PLOTS = ["pupil", "latency", "stages", "fields"]

# How many of a plot's pixels are of one of the style sheet's colours, which is given as it is computed.
COUNT_PIXELS = """
const [id, name] = arguments;
const canvas = document.getElementById(id);
const probe = document.createElement("canvas").getContext("2d");
probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
probe.fillRect(0, 0, 1, 1);
const [r, g, b] = probe.getImageData(0, 0, 1, 1).data;
const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
let count = 0;
for (let i = 0; i < pixels.length; i += 4) {
  if (pixels[i] === r && pixels[i + 1] === g && pixels[i + 2] === b && pixels[i + 3] === 255) count += 1;
}
return count;
"""


def text(browser: webdriver.Chrome, element_id: str) -> str:
    return browser.find_element(By.ID, element_id).text


def drawing(browser: webdriver.Chrome, plot: str) -> str:
    return browser.execute_script("return document.getElementById(arguments[0]).toDataURL()", plot)


def pixels(browser: webdriver.Chrome, plot: str, name: str) -> int:
    return browser.execute_script(COUNT_PIXELS, plot, name)


def faults(browser: webdriver.Chrome) -> list[dict[str, Any]]:
    """What the browser complains of: a fault in a script, something that cannot be loaded."""
    return [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


@pytest.fixture
def page(start: Start, browser: webdriver.Chrome) -> Holod:
    holod = start()
    browser.get_log("browser")
    browser.get(holod.place)
    wait_for("the page says that it runs", lambda: text(browser, "state") == "running")
    return holod


def test_plots_move_and_can_be_held(page: Holod, browser: webdriver.Chrome) -> None:
    assert text(browser, "lasers") == "lasers: armed"
    wait_for("the estimate is drawn", lambda: pixels(browser, "pupil", "estimate") > 100)
    wait_for("samples are drawn", lambda: pixels(browser, "pupil", "sample") > 100)
    wait_for("dropouts are drawn", lambda: pixels(browser, "pupil", "refused") > 5)
    wait_for("the engine's time is drawn", lambda: pixels(browser, "stages", "engine") > 50)
    for laser in ["red", "green", "blue"]:
        wait_for(f"the {laser} laser's windows are drawn", lambda name=laser: pixels(browser, "fields", name) > 50)
    assert pixels(browser, "pupil", "blue") == 0, "the count knows colours from each other"
    before = {plot: drawing(browser, plot) for plot in PLOTS}
    for plot in PLOTS:
        wait_for(f"{plot} moves", lambda name=plot: drawing(browser, name) != before[name])
    wait_for("figures are told", lambda: "samples a second" in text(browser, "pupil-text"))
    wait_for("light is told", lambda: "median since the tracker’s sample" in text(browser, "latency-text"))
    browser.find_element(By.ID, "still").click()
    time.sleep(0.3)
    held = {plot: drawing(browser, plot) for plot in PLOTS}
    time.sleep(1.5)
    assert {plot: drawing(browser, plot) for plot in PLOTS} == held
    assert faults(browser) == []


def test_an_eye_looks_where_it_is_told_by_keyboard(page: Holod, browser: webdriver.Chrome) -> None:
    page.ctl("pupil", "5")

    def seen() -> tuple[int, str] | None:
        picture = browser.find_element(By.ID, "eye")
        frame = picture.get_attribute("data-frame")
        return (int(frame), picture.get_attribute("alt")) if frame else None

    wait_for("a picture of 5 mm at infinity", lambda: (s := seen()) and "5.00 mm focused at 0 dpt" in s[1])
    size = browser.execute_script("const p = document.getElementById('eye'); return [p.naturalWidth, p.naturalHeight]")
    assert size == [64, 64]
    focus = browser.find_element(By.ID, "focus")
    for _ in range(10):
        focus.send_keys(Keys.ARROW_RIGHT)
    assert text(browser, "focus-text") == "1 dpt, 100 cm"
    wait_for("a picture at 1 dpt", lambda: (s := seen()) and "focused at 1 dpt" in s[1])
    first = seen()
    wait_for("a newer picture", lambda: seen()[0] > first[0])
    assert faults(browser) == []


def test_lasers_that_are_kept_dark_are_seen_dark(page: Holod, browser: webdriver.Chrome) -> None:
    wait_for("fields are lit", lambda: pixels(browser, "fields", "green") > 50)
    page.ctl("lasers", "dark")
    wait_for("the badge says dark", lambda: text(browser, "lasers") == "lasers: dark, by order")
    dark = lambda: all(pixels(browser, "fields", laser) == 0 for laser in ["red", "green", "blue"])  # noqa: E731
    wait_for("no window is drawn", dark)
    assert pixels(browser, "fields", "field") > 50, "patterns are still on the panel"
    wait_for("the picture says so", lambda: "The lasers are dark" in text(browser, "eye-text"))
    page.ctl("lasers", "arm")
    wait_for("fields are lit again", lambda: pixels(browser, "fields", "green") > 50)
    assert text(browser, "lasers") == "lasers: armed"


# A client of the feed: a grey picture thirty times a second.
CLIENT = """
import sys, time
import numpy as np
import holod_client
with holod_client.Feed(64, 64, depth="none", plane_dpt=1.0, name="grey", path=sys.argv[1]) as feed:
    while True:
        feed.send(np.full((64, 64, 4), 128, np.uint8))
        time.sleep(1 / 30)
"""


def test_a_feed_that_stands_still_is_seen_dark_until_it_goes_on(start: Start, browser: webdriver.Chrome) -> None:
    holod = start("--scene", "feed", "--feed-dark-after", "1")
    browser.get_log("browser")
    client = subprocess.Popen([sys.executable, "-c", CLIENT, str(holod.folder / "holod/feed")])
    try:
        browser.get(holod.place)
        wait_for("the page names the client", lambda: "grey; 1 clients" in text(browser, "facts"))
        wait_for("the page says that it is lit", lambda: text(browser, "lasers") == "lasers: armed")
        wait_for("fields are lit", lambda: pixels(browser, "fields", "green") > 50)
        client.send_signal(signal.SIGSTOP)
        wait_for("the badge says dark, and why", lambda: text(browser, "lasers") == "lasers: dark, no pictures")
        dark = lambda: all(pixels(browser, "fields", laser) == 0 for laser in ["red", "green", "blue"])  # noqa: E731
        wait_for("no window is drawn", dark)
        wait_for("the reason stands at the fields", lambda: "dark: no-picture" in text(browser, "fields-text"))
        trouble = "lasers dark: the feed's client `grey` has given no new picture for 1 s (--feed-dark-after)"
        wait_for("it names the client", lambda: trouble in text(browser, "facts") and trouble in text(browser, "log"))
        assert b"\nholod_feed_keeps_dark 1" in holod.get("/metrics")[1]
        client.send_signal(signal.SIGCONT)
        wait_for("the badge says armed", lambda: text(browser, "lasers") == "lasers: armed")
        wait_for("fields are lit again", lambda: pixels(browser, "fields", "green") > 50)
        assert trouble not in text(browser, "facts")
        client.kill()
        wait_for("a dead client is dark, too", lambda: text(browser, "lasers") == "lasers: dark, no pictures")
        assert faults(browser) == []
    finally:
        client.kill()
        client.wait()


def test_orders_and_troubles_are_in_the_log(page: Holod, browser: webdriver.Chrome) -> None:
    page.ctl("pause")
    wait_for("the state says so", lambda: text(browser, "state") == "running, paused")
    wait_for("the log has it", lambda: 'asked for: {"do":"pause"}' in text(browser, "log"))
    assert "Scene the built-in scene" in text(browser, "facts").replace("\n", " ")
    assert "samples" in text(browser, "counters")


def test_a_run_in_which_nothing_changes_is_told_as_that(page: Holod, browser: webdriver.Chrome) -> None:
    wait_for("light is told", lambda: "median since the tracker’s sample" in text(browser, "latency-text"))
    wait_for("the engine's time is told", lambda: "computed in 10 s; the engine takes" in text(browser, "stages-text"))
    page.ctl("pupil", "5")
    wait_for("no latency is told", lambda: text(browser, "latency-text") == "nothing new in 10 s")
    assert ", none of them computed in 10 s: there was nothing new; " in text(browser, "stages-text")
    wait_for("fields are lit all the same", lambda: pixels(browser, "fields", "green") > 50)
    assert faults(browser) == []


def test_a_daemon_that_hangs_is_told(page: Holod, browser: webdriver.Chrome) -> None:
    page.process.send_signal(signal.SIGSTOP)
    wait_for("its silence is told", lambda: "holod has said nothing for" in text(browser, "alert"))
    assert text(browser, "lasers") == "lasers: not known"
    page.process.send_signal(signal.SIGCONT)
    wait_for("all is well again", lambda: text(browser, "state") == "running")
    assert not browser.find_element(By.ID, "alert").is_displayed()


def test_a_daemon_that_dies_is_told(page: Holod, browser: webdriver.Chrome) -> None:
    page.process.kill()
    page.process.wait()
    wait_for("its death is told", lambda: "No connection to holod" in text(browser, "alert"))
    assert "Look at the lasers themselves" in text(browser, "alert")
    assert (text(browser, "state"), text(browser, "lasers")) == ("not connected", "lasers: not known")


def test_one_viewer_too_many_is_told_why(start: Start, browser: webdriver.Chrome) -> None:
    holod = start()
    viewers = []
    for _ in range(64):
        viewer = http.client.HTTPConnection("127.0.0.1", holod.port, timeout=PATIENCE_S)
        viewer.request("GET", "/events")
        assert viewer.getresponse().status == 200
        viewers.append(viewer)
    browser.get(holod.place)
    wait_for("the page says why", lambda: "64 browsers watch already" in text(browser, "alert"))
    assert (text(browser, "state"), text(browser, "lasers")) == ("not connected", "lasers: not known")
    for viewer in viewers:
        viewer.close()
    wait_for("there is room", lambda: b"holod_page_viewers 0" in holod.get("/metrics")[1])
    browser.refresh()
    wait_for("the page says that it runs", lambda: text(browser, "state") == "running")
    assert not browser.find_element(By.ID, "alert").is_displayed()


def test_a_run_that_ends_is_told(page: Holod, browser: webdriver.Chrome) -> None:
    assert page.end() == 0
    wait_for("its end is told", lambda: "The run ended" in text(browser, "alert"))
    assert text(browser, "state") == "ended"


def test_everything_has_a_name_for_those_who_do_not_see(page: Holod, browser: webdriver.Chrome) -> None:
    browser.execute_cdp_cmd("Accessibility.enable", {})
    tree = browser.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    named = {"image", "slider", "checkbox", "combobox", "table", "log", "alert", "status"}
    nodes = [(node["role"]["value"], node.get("name", {}).get("value", "")) for node in tree if not node["ignored"]]
    for role, name in nodes:
        assert name or role not in named - {"alert", "status", "table"}, f"a nameless {role}"
    roles = [role for role, _ in nodes]
    assert roles.count("image") + roles.count("img") >= 5
    assert {"slider", "combobox", "log", "status"} <= set(roles), sorted(set(roles))
    assert ("heading", "Pupil") in nodes and ("combobox", "Pupil mm") in nodes
    assert browser.find_element(By.ID, "focus").get_attribute("aria-valuetext") == "0 dpt, infinity"


def test_both_themes_are_drawn_in_their_own_colours(start: Start, browser: webdriver.Chrome) -> None:
    """With HOLOD_SCREENSHOTS naming a folder, it leaves pictures of both there: those of daemon/doc."""
    folder = os.environ.get("HOLOD_SCREENSHOTS")
    browser.get(start(*(["--resolution", "256x256"] if folder else [])).place)
    grounds = set()
    for theme in ["light", "dark"]:
        features = [{"name": "prefers-color-scheme", "value": theme}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        wait_for(f"the estimate is drawn in the {theme} theme", lambda: pixels(browser, "pupil", "estimate") > 100)
        grounds.add(browser.execute_script("return getComputedStyle(document.body).backgroundColor"))
        if folder:
            time.sleep(10)
            shot = browser.execute_cdp_cmd("Page.captureScreenshot", {"captureBeyondViewport": True})["data"]
            (Path(folder) / f"page-{theme}.png").write_bytes(base64.b64decode(shot))
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert len(grounds) == 2
