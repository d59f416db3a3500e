"""A real holod with its status page, and a browser that looks at it."""

from __future__ import annotations

import http.client
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

PATIENCE_S = 60.0


def wait_for(what: str, seen: Callable[[], Any], patience_s: float = PATIENCE_S) -> Any:
    """What `seen` returns once that is true; fails with `what` where it never is."""
    t_end = time.monotonic() + patience_s
    while True:
        value = seen()
        if value:
            return value
        assert time.monotonic() < t_end, f"not within {patience_s:.0f} s: {what}"
        time.sleep(0.05)


class Holod:
    """A holod whose page is at `port`."""

    def __init__(self, binary: str, folder: Path, *options: str) -> None:
        self.folder = folder
        self.binary = binary
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
        self.log = folder / "log"
        usual = {"resolution": "64x64", "weights": "fast", "backend": "cpu", "tracker": "mock:dropouts", "page": "0"}
        unnamed = [f"--{name}={value}" for name, value in usual.items() if f"--{name}" not in options]
        with self.log.open("w") as log:
            self.process = subprocess.Popen([binary, "run", *unnamed, *options], env=self.environment, stderr=log)
        said = wait_for("holod says where its page is", lambda: self.said(r"the status page is at (\S+)"))
        self.place: str = said[1]
        self.port = int(port[1]) if (port := re.search(r":(\d+)/$", self.place)) else None

    def said(self, pattern: str) -> re.Match[str] | None:
        log = self.log.read_text()
        assert self.process.poll() is None, log
        return re.search(pattern, log)

    def get(self, path: str, **headers: str) -> tuple[http.client.HTTPResponse, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer, answer.read()

    def status(self) -> dict[str, Any]:
        """The newest snapshot, once there is one that knows of frames."""

        def known() -> dict[str, Any] | None:
            answer, body = self.get("/status.json")
            status = json.loads(body) if answer.status == 200 else {}
            return status if status.get("frames_shown", 0) > 0 else None

        return wait_for("frames are shown", known)

    def ctl(self, *order: str) -> str:
        command = [self.binary, "ctl", "--pid", str(self.process.pid), *order]
        return subprocess.run(command, env=self.environment, check=True, capture_output=True, text=True).stdout

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE_S)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Holod]]:
    """Starts holods; none of them outlives the test."""
    binary = os.environ.get("HOLOD")
    if binary is None:
        assert "CI" not in os.environ, "HOLOD must name the daemon: its page is tested"
        pytest.skip("HOLOD does not name the daemon, such as target/release/holod")
    running: list[Holod] = []

    def start_one(*options: str) -> Holod:
        folder = tmp_path / str(len(running))
        folder.mkdir()
        running.append(Holod(binary, folder, *options))
        return running[-1]

    yield start_one
    for holod in running:
        if holod.process.poll() is None:
            holod.process.send_signal(signal.SIGCONT)
            holod.process.kill()
            holod.process.wait()


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    """Debian's Chromium, without a window."""
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        assert "CI" not in os.environ, "chromium and chromedriver (Debian's chromium-driver) must be there"
        pytest.skip("chromium and chromedriver are not installed")
    options = Options()
    options.binary_location = chromium
    profile = tmp_path_factory.mktemp("chromium")
    for switch in [
        "headless=new",
        "no-sandbox",  # it refuses to run as root otherwise
        "disable-gpu",
        "disable-dev-shm-usage",
        "no-first-run",
        "disable-background-networking",
        "disable-component-update",
        "disable-sync",
        "window-size=1300,1400",
        f"user-data-dir={profile}",
    ]:
        options.add_argument(f"--{switch}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=Service(driver))
    chrome.set_script_timeout(PATIENCE_S)
    yield chrome
    chrome.quit()
