"""Charts of a report as a browser draws them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from replay.reports.charts import Charts, signal_chart
from replay.reports.report_html import page

pytestmark = pytest.mark.system

NOTED = """const fill = CanvasRenderingContext2D.prototype.fillText; window.drawn = {};
CanvasRenderingContext2D.prototype.fillText = function (words, x, y) {
  window.drawn[words] = [x, y, this.measureText(words).width]; return fill.apply(this, arguments);
};"""
"""Notes what is written where on the page's canvases."""


def test_names_of_moments_stay_inside_a_chart_and_beside_each_other(tmp_path: Path) -> None:
    charts, chart = Charts(), signal_chart("height", np.arange(8.0, 100.0), np.zeros((92, 1)), ["height"], "m")
    chart.content["marks"] = [[0.0, "mode A"], [1.0, "mode STABILIZE"], [50.0, "mode LOITER"], [50.5, "mode LAND"]]
    (tmp_path / "page.html").write_text(page("t", charts.add(chart), charts=charts.to_json()))
    options = webdriver.ChromeOptions()
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.binary_location = shutil.which("chromium") or ""
    with webdriver.Chrome(options, Service(shutil.which("chromedriver"))) as browser:
        browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": NOTED})
        browser.get((tmp_path / "page.html").as_uri())
        drawn = browser.execute_script("return window.drawn")
        left = browser.execute_script("return document.querySelector('.u-over').offsetLeft")
    assert "mode A" not in drawn
    assert drawn["mode STABILIZE"][0] > left
    (loiter_x, loiter_y, wide), (land_x, land_y, _) = drawn["mode LOITER"], drawn["mode LAND"]
    assert land_x < loiter_x + wide
    assert land_y > loiter_y
