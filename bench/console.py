"""The console with simulated vehicles for some minutes: memory of server and pages, processor, delay of alarms.

    python bench/console.py --minutes 30

Needs chromium and chromedriver (Debian: chromium-driver) and the extra `dev`. Prints a line a minute and a summary.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "tools"), str(ROOT / "tests")]

from fleet_publisher import SimulatedMonitor  # noqa: E402
from loopback import free_port  # noqa: E402

from adapters.zenoh.zenoh_session import open_session  # noqa: E402

RATE_HZ = 10.0
ALARM_S = 2.0


def memory_mb(process: int) -> float:
    """Return the resident memory of a process."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def seconds_of(process: int) -> float:
    """Return the processor time of a process."""
    words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def page(url: str) -> webdriver.Chrome:
    """Open a page in a browser of its own."""
    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--enable-precise-memory-info"):
        options.add_argument(argument)
    options.binary_location = shutil.which("chromium") or ""
    driver = webdriver.Chrome(options, Service(shutil.which("chromedriver")))
    driver.get(url)
    # when a message was first seen on the page, by what the clocks of one machine say
    driver.execute_script(
        """
        window.seenAt = {};
        new MutationObserver(() => {
          for (const cell of document.querySelectorAll("td.what")) seenAt[cell.textContent] ??= Date.now() / 1000;
        }).observe(document.body, { subtree: true, childList: true, characterData: true });
        """
    )
    return driver


def heap_mb(driver: webdriver.Chrome) -> float:
    """Return the heap of a page's scripts after their garbage was collected."""
    driver.execute_cdp_cmd("HeapProfiler.collectGarbage", {})
    return float(driver.execute_script("return performance.memory.usedJSHeapSize")) / 1e6


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--vehicles", type=int, default=16)
    args = parser.parse_args()
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    session = open_session(listen=[endpoint])
    monitors = [SimulatedMonitor(session, f"quad-{k + 1}", k) for k in range(args.vehicles)]
    command = [sys.executable, "-m", "fauio", "console", "--connect", endpoint, "--listen", f"127.0.0.1:{port}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as server:  # noqa: S603 - our own
        assert server.stdout is not None
        url = server.stdout.readline().split()[0]
        pages = [page(url), page(f"{url}#/vehicle/quad-1")]
        raised = publish(monitors, args.minutes, server.pid, pages)
        seen = pages[0].execute_script("return seenAt")
        delays = sorted(seen[message] - at for message, at in raised.items() if message in seen)
        print(
            f"{len(raised)} alarms raised, {len(raised) - len(delays)} not seen; seen after "
            f"{delays[len(delays) // 2]:.2f} s (median), {delays[-1]:.2f} s (longest)"
        )
        for driver in pages:
            driver.quit()
        server.terminate()
    session.close()


def publish(
    monitors: list[SimulatedMonitor], minutes: float, server: int, pages: list[webdriver.Chrome]
) -> dict[str, float]:
    """Publish for some minutes and print figures each; return when which message was raised."""
    raised: dict[str, float] = {}
    active: list[tuple[SimulatedMonitor, str]] = []
    begun = time.time()
    used = seconds_of(server)
    turn = 0
    while time.time() < begun + 60.0 * minutes:
        now = time.time()
        for monitor in monitors:
            monitor.estimates(now)
            if turn % round(RATE_HZ) == monitor.number % round(RATE_HZ):
                monitor.status(now)
        if turn % round(ALARM_S * RATE_HZ) == 0:
            monitor = monitors[len(raised) % len(monitors)]
            message = f"motor{len(raised) % 4 + 1} delivers less, alarm {len(raised)}"
            raised[message] = time.time()
            active.append((monitor, monitor.alarm(f"motor{len(raised) % 4 + 1}", -0.02, message).channel))
            if len(active) > 10:
                old, channel = active.pop(0)
                if channel in old.active:
                    old.change(channel, "cleared")
        turn += 1
        if turn % round(60 * RATE_HZ) == 0:
            since = time.time() - begun
            heaps = ", ".join(f"{heap_mb(driver):.1f}" for driver in pages)
            share = 100 * (seconds_of(server) - used) / since
            said = f"server {memory_mb(server):.1f} MB, {share:.1f} % of a core; pages {heaps} MB"
            print(f"{since / 60:.1f} min: {said}", flush=True)
        time.sleep(max(0.0, begun + turn / RATE_HZ - time.time()))
    return raised


if __name__ == "__main__":
    main()
