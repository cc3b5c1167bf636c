"""The console as a browser shows it: Chromium without a window, against monitors' real Zenoh sessions."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fleet_publisher import SimulatedMonitor
from loopback import Endpoint, free_port, shown_from_now_on
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from monitor.console.web_server import ConsoleOptions, ConsoleServer

pytestmark = pytest.mark.system

HOSTILE = "<img src=x onerror=document.title='owned'>"


@pytest.fixture(scope="module")
def browser() -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,900"):
        options.add_argument(argument)
    options.binary_location = shutil.which("chromium") or ""
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, Service(shutil.which("chromedriver")))
    yield driver
    driver.quit()


@pytest.fixture
def monitor(endpoint: Endpoint) -> Iterator[SimulatedMonitor]:
    made = SimulatedMonitor(endpoint.session, "quad-1", allow=("ack", "shelve", "unshelve", "reset"))
    yield made
    made.close()


@pytest.fixture
def serve(endpoint: Endpoint, browser: webdriver.Chrome) -> Iterator[Callable[..., ConsoleServer]]:
    made: list[ConsoleServer] = []

    def make(port: int = 0, **options: Any) -> ConsoleServer:
        made.append(ConsoleServer(endpoint.client(), ConsoleOptions(listen=f"127.0.0.1:{port}", **options)))
        shown_from_now_on(endpoint)
        return made[-1]

    browser.get_log("browser")
    yield make
    browser.get("about:blank")
    for one in made:
        one.close()


def text(browser: webdriver.Chrome, selector: str) -> str:
    return str(browser.execute_script("return document.querySelector(arguments[0])?.innerText ?? ''", selector))


def shows(browser: webdriver.Chrome, selector: str, words: str, seconds: float = 15.0) -> float:
    """Wait until an element shows some words; return how long that took, seconds."""
    started = time.monotonic()
    WebDriverWait(browser, seconds, 0.02).until(
        lambda driver: words in text(driver, selector), f"{selector} shows: {text(browser, selector)}"
    )
    return time.monotonic() - started


def press(browser: webdriver.Chrome, words: str) -> None:
    dialog = browser.find_elements(By.CSS_SELECTOR, "dialog[open] button")
    buttons = dialog or browser.find_elements(By.CSS_SELECTOR, "td.actions button")
    next(button for button in buttons if button.text == words and button.is_displayed()).click()


def complaints(browser: webdriver.Chrome) -> list[str]:
    """Return what the page's console says, but for connections that were lost on purpose."""
    return [line["message"] for line in browser.get_log("browser") if "net::ERR" not in line["message"]]


def test_an_alarm_appears_within_a_second_and_goes_when_it_clears(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], monitor: SimulatedMonitor
) -> None:
    browser.get(serve().url)
    shows(browser, ".cards", "quad-1")
    monitor.status(time.time())
    shows(browser, ".cards", "LOITER" if int(time.time() / 60) % 2 else "AUTO")
    monitor.alarm("gps_north", 12.0, "GPS is 12 m too far north", severity="critical")
    assert shows(browser, "table.alarms tbody", "GPS is 12 m too far north") < 1.0
    shows(browser, "#summary", "1 critical")
    assert browser.title == "(1) fauio"
    assert not browser.find_elements(By.CSS_SELECTOR, "td.actions button")
    monitor.change("gps_north", "cleared")
    shows(browser, "table.alarms tbody tr[data-group=cleared]", "cleared")
    assert complaints(browser) == []


def test_nothing_is_said_to_be_well_before_the_server_has_said_anything(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], monitor: SimulatedMonitor
) -> None:
    url = serve().url
    browser.execute_cdp_cmd("Network.enable", {})
    browser.execute_cdp_cmd("Network.setBlockedURLs", {"urls": [f"{url.rstrip('/')}/stream"]})
    try:
        browser.get(url)
        shows(browser, "#connection", "no connection")
        assert text(browser, "main") == "Fleet\nAlarms\nVehicles"
    finally:
        browser.execute_cdp_cmd("Network.setBlockedURLs", {"urls": []})
    browser.get(url)
    shows(browser, "main", "No alarm is active.")


def test_an_alarm_is_acknowledged_shelved_and_closed(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], monitor: SimulatedMonitor
) -> None:
    browser.get(serve(commands=True).url)
    monitor.alarm("motor1", -0.02, "motor1 delivers 5 % less")
    shows(browser, "td.actions", "Acknowledge")
    press(browser, "Acknowledge")
    WebDriverWait(browser, 15).until(lambda _: monitor.answer() == ["ack"])
    shows(browser, "td.state", "acknowledged")
    shows(browser, "#said", "done")
    assert "motor1 delivers 5 % less" in text(browser, "td.what")
    browser.find_element(By.CSS_SELECTOR, "table.alarms tbody tr").send_keys("s")
    press(browser, "Shelve")
    WebDriverWait(browser, 15).until(lambda _: monitor.answer() == ["shelve"])
    shows(browser, "td.state", "shelved until")
    press(browser, "Close")
    shows(browser, "dialog[open]", "begins anew")
    press(browser, "Close")
    WebDriverWait(browser, 15).until(lambda _: monitor.answer() == ["reset"])
    shows(browser, "td.state", "cleared")


def test_names_and_messages_are_never_markup(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], endpoint: Endpoint
) -> None:
    name = HOSTILE.replace("/", "_").replace(" ", "_")
    monitor = SimulatedMonitor(endpoint.session, name)
    browser.get(serve().url)
    monitor.text(time.time(), HOSTILE, 2)
    monitor.status(time.time(), "blind", reasons=[HOSTILE, "\x1b[31m"])
    monitor.alarm(HOSTILE, 1e308, HOSTILE, unit=HOSTILE, observer=HOSTILE)
    shows(browser, "table.alarms tbody", HOSTILE)
    browser.find_element(By.CSS_SELECTOR, ".card a").click()
    shows(browser, "h1", name)
    monitor.estimates(time.time())
    shows(browser, ".messages", HOSTILE)
    shows(browser, ".reasons", HOSTILE)
    browser.get(browser.current_url.partition("#")[0] + "#/history")
    shows(browser, "table.history", HOSTILE)
    assert browser.find_elements(By.CSS_SELECTOR, "img:not([src='/page/mark.svg'])") == []
    assert "owned" not in browser.title
    monitor.close()


def test_a_vehicles_page_draws_what_is_published(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], monitor: SimulatedMonitor
) -> None:
    browser.get(serve().url + "#/vehicle/quad-1")
    now = time.time()
    monitor.text(now, "EKF3 IMU0 is using GPS")
    for k in range(40):
        monitor.estimates(now - 10 + k / 4)
    monitor.alarm("gps_east", 12.0, "GPS is 12 m too far east")
    monitor.estimates(now + 1)

    def pulled(_: object) -> bool:
        # a status overtakes the estimate that was published before it
        monitor.status(time.time())
        return "GPS is pulled by" in text(browser, ".map")

    WebDriverWait(browser, 15).until(pulled)
    shows(browser, ".messages", "EKF3 IMU0 is using GPS")
    # what is not seen is not drawn
    browser.execute_script("document.querySelector('.charts .chart:last-child').scrollIntoView()")
    WebDriverWait(browser, 15).until(lambda driver: len(driver.find_elements(By.CSS_SELECTOR, ".uplot")) > 2)
    captions = [one.text for one in browser.find_elements(By.CSS_SELECTOR, "#main .chart figcaption")]
    assert [caption.split("\n")[0].split()[0] for caption in captions[:4]] == [f"motor{k}" for k in range(1, 5)]
    assert "threshold 5" in next(caption for caption in captions if caption.startswith("gps_east"))
    assert "inertial/gps_east" in text(browser, ".lane.alarms")
    assert complaints(browser) == []


def test_the_page_comes_back_after_monitor_and_server_were_restarted(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], endpoint: Endpoint
) -> None:
    port = free_port()
    monitor = SimulatedMonitor(endpoint.session, "quad-1")
    server = serve(port)
    browser.get(server.url)
    shows(browser, ".cards", "quad-1")
    monitor.status(time.time())
    shows(browser, ".cards", "watched")
    monitor.close()
    shows(browser, ".cards", "monitor gone")
    monitor = SimulatedMonitor(endpoint.session, "quad-1")
    monitor.status(time.time())
    shows(browser, ".cards", "watched")
    server.close()
    shows(browser, "#lost", "No connection to the console")
    monitor.alarm("motor2", -0.02, "motor2 delivers less")
    serve(port)
    shows(browser, "table.alarms tbody", "motor2 delivers less")
    assert text(browser, "#lost") == ""
    monitor.close()


def test_a_token_is_asked_for_and_again_when_it_is_another(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], monitor: SimulatedMonitor
) -> None:
    port = free_port()
    server = serve(port, token="a" * 16)
    browser.get(server.url)
    shows(browser, "h1", "fauio")
    browser.find_element(By.ID, "token").send_keys("b" * 16, Keys.ENTER)
    shows(browser, "#said", "not the token")
    browser.find_element(By.ID, "token").clear()
    browser.find_element(By.ID, "token").send_keys("a" * 16, Keys.ENTER)
    shows(browser, ".cards", "quad-1")
    server.close()
    serve(port, token="c" * 16)
    WebDriverWait(browser, 20).until(lambda driver: driver.current_url.endswith("/login"))
    browser.delete_all_cookies()


def test_keys_lead_through_the_pages(
    browser: webdriver.Chrome, serve: Callable[..., ConsoleServer], monitor: SimulatedMonitor
) -> None:
    browser.get(serve().url)
    shows(browser, ".cards", "quad-1")
    body = browser.find_element(By.TAG_NAME, "body")
    body.send_keys("1")
    shows(browser, "h1", "quad-1")
    body.send_keys("h")
    shows(browser, "h1", "History")
    body.send_keys("f")
    shows(browser, ".card h2", "quad-1")
    body.send_keys("?")
    shows(browser, "dialog[open]", "Keys")
    browser.find_element(By.CSS_SELECTOR, "dialog").send_keys(Keys.ESCAPE)
    body.send_keys("t")
    assert browser.execute_script("return document.documentElement.dataset.theme") == "dark"
    body.send_keys("tt")
    monitor.alarm("motor1", -0.02, "motor1 delivers less")
    shows(browser, "table.alarms tbody", "motor1")
    body.send_keys("j")
    assert browser.switch_to.active_element.tag_name == "tr"


@pytest.mark.timeout(180)
def test_the_demonstration_is_seen_in_a_browser_and_ends_on_an_interrupt(
    browser: webdriver.Chrome, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "fauio", "demo", "copter", "--console", "--speed", "4", "--out", str(tmp_path)]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as demo:
        assert demo.stdout is not None
        said: list[str] = []
        while "in a browser" not in "".join(said):
            said.append(demo.stdout.readline())
        browser.get(said[-1].split()[1])
        shows(browser, "table.alarms tbody", "motors/motor1", 60.0)
        while "until Ctrl-C" not in said[-1]:
            said.append(demo.stdout.readline())
        demo.send_signal(signal.SIGINT)
        rest = demo.communicate(timeout=60)[0]
    assert "the same" in rest
    assert demo.returncode == 0, rest
    assert list(tmp_path.glob("clips/quad/*.mcap"))


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_it_fits_the_screen_and_texts_are_legible(
    browser: webdriver.Chrome,
    serve: Callable[..., ConsoleServer],
    monitor: SimulatedMonitor,
    theme: str,
    width: int,
) -> None:
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    features = [{"name": "prefers-color-scheme", "value": theme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    monitor.alarm("motor1", -0.02, "motor1 delivers less")
    monitor.alarm("baro", 9.0, "baro is off", severity="critical")
    monitor.status(time.time(), "blind", reasons=["no HIGHRES_IMU for 12 s"])
    url = serve(commands=True).url
    for page, words in (("", "baro"), ("#/vehicle/quad-1", "baro"), ("#/history", "baro is off")):
        browser.get(url + page)
        shows(browser, "#main", words)
        assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")
        # what is for screen readers alone takes no room, however long it is
        assert browser.execute_script("return document.getElementById('alert').offsetWidth") == 1
        assert browser.execute_script(_PALE) == []
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


# Texts whose contrast is below the 4.5 of WCAG 2.2 AA, by the luminances that it defines.
_PALE = """
const numbers = (colour) => colour.match(/[0-9.]+/g).map(Number);
const light = ([r, g, b]) => {
  const [R, G, B] = [r, g, b].map((c) => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
  return 0.2126 * R + 0.7152 * G + 0.0722 * B;
};
const ground = (element) => {
  for (; element; element = element.parentElement) {
    const colour = numbers(getComputedStyle(element).backgroundColor);
    if (colour.length < 4 || colour[3] === 1) return colour;
  }
  return [255, 255, 255];
};
const pale = [];
for (const element of document.querySelectorAll("body *")) {
  if (![...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim())) continue;
  if (!element.checkVisibility()) continue;
  const lights = [numbers(getComputedStyle(element).color), ground(element)].map(light).sort((a, b) => b - a);
  const contrast = (lights[0] + 0.05) / (lights[1] + 0.05);
  if (contrast < 4.5) pale.push(`${element.className} ${element.textContent}: ${contrast.toFixed(2)}`);
}
return pale;
"""
