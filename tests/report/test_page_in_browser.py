from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.made_report import sample
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement

from ril.report.page import page

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--window-size=1280,900",
)
CELLS: list[dict[str, object]] = [
    {"env": "cartpole", "run_id": "r", "aer": 400.0},
    {"env": "cartpole", "run_id": "r", "aer": 420.0, "seed": 1},
    {"env": "cartpole", "run_id": "s", "aer": 300.0, "trajectories": 25},
    {"env": "cartpole", "run_id": "b", "aer": 100.0, "method": "bc", "k": None, "n": None},
    {"env": "cartpole", "run_id": "g", "aer": 500.0, "method": "gail", "k": None, "n": None},
]
#: Least ratio of luminances between visible texts and what is painted behind them.
CONTRAST = """
const context = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
const painted = (colors) => {
  context.clearRect(0, 0, 1, 1);
  for (const color of colors) { context.fillStyle = color; context.fillRect(0, 0, 1, 1); }
  return [...context.getImageData(0, 0, 1, 1).data].slice(0, 3);
};
const linear = (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
const luminance = (rgb) => {
  const [r, g, b] = rgb.map((v) => linear(v / 255));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const ratios = new Map();
const texts = [...document.querySelectorAll("body *")].filter((element) =>
  element.checkVisibility() && !element.closest("svg, script, .again, .visually-hidden") &&
  [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim()));
for (const element of texts) {
  const behind = [];
  for (let at = element; at; at = at.parentElement) {
    behind.unshift(getComputedStyle(at).backgroundColor);
  }
  const colors = [...behind, getComputedStyle(element).color];
  if (ratios.has(colors.join())) continue;
  const [low, high] = [behind, colors].map(painted).map(luminance).sort((a, b) => a - b);
  ratios.set(colors.join(), [(high + 0.05) / (low + 0.05), element.outerHTML.slice(0, 90)]);
}
return [...ratios.values()];
"""


@pytest.fixture(scope="module")
def chromium() -> Iterator[webdriver.Chrome]:
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in programs:
        pytest.skip("needs chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = str(programs[0])
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, Service(str(programs[1])))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("page") / "report.html"
    report = sample(*CELLS, tables=("table2", "table6", "table7"))
    file.write_text(page(report), encoding="utf-8")
    return Path(file).as_uri()


@pytest.fixture
def browser(chromium: webdriver.Chrome, url: str) -> webdriver.Chrome:
    """The page just opened, light and wide."""
    emulated(chromium, "light", 1280)
    chromium.get("about:blank")
    chromium.get(url)
    return chromium


def emulated(browser: webdriver.Chrome, scheme: str, width: int) -> None:
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def head(browser: webdriver.Chrome, table: str, column: str) -> WebElement:
    path = f"//*[@id='{table}']//thead//th[starts-with(normalize-space(), '{column}')]"
    return browser.find_element(By.XPATH, path)


def press(browser: webdriver.Chrome, table: str, column: str, times: int = 1) -> None:
    for _ in range(times):
        head(browser, table, column).find_element(By.TAG_NAME, "button").send_keys(Keys.ENTER)


def labels(browser: webdriver.Chrome, table: str) -> list[list[str]]:
    """The labels of a table's rows from top to bottom."""
    script = """return [...document.querySelectorAll(`#${arguments[0]} tbody tr`)]
        .map((row) => [...row.querySelectorAll("th")].map((label) => label.textContent))"""
    found: list[list[str]] = browser.execute_script(script, table)
    return found


def methods(browser: webdriver.Chrome) -> list[str]:
    return [method for method, measure in labels(browser, "table2") if measure == "AER"]


def test_the_console_is_empty(browser: webdriver.Chrome) -> None:
    browser.get_log("browser")
    browser.refresh()
    assert browser.get_log("browser") == []


def test_nothing_is_requested(browser: webdriver.Chrome) -> None:
    script = "return performance.getEntriesByType('resource').map((entry) => entry.name)"
    assert browser.execute_script(script) == []


def test_every_figure_is_visible(browser: webdriver.Chrome) -> None:
    figures = browser.find_elements(By.CSS_SELECTOR, "figure svg")
    assert len(figures) == 1
    for figure in figures:
        assert figure.is_displayed()
        assert min(figure.size.values()) > 100


def test_a_head_sorts_up_then_down_then_back(browser: webdriver.Chrome) -> None:
    original = methods(browser)
    missing = [name for name in original if name not in ("BC", "GAIL", "RIL")]
    orders = []
    for _ in range(3):
        head(browser, "table2", "CartPole").find_element(By.TAG_NAME, "button").click()
        orders.append(methods(browser))
    assert orders == [["BC", "RIL", "GAIL", *missing], ["GAIL", "RIL", "BC", *missing], original]


def test_a_head_says_how_it_sorts(browser: webdriver.Chrome) -> None:
    states = []
    for _ in range(3):
        press(browser, "table2", "CartPole")
        states.append(head(browser, "table2", "CartPole").get_attribute("aria-sort"))
    assert states == ["ascending", "descending", "none"]


def test_another_head_takes_over(browser: webdriver.Chrome) -> None:
    press(browser, "table2", "CartPole")
    press(browser, "table2", "Method", times=2)
    assert head(browser, "table2", "CartPole").get_attribute("aria-sort") == "none"
    assert methods(browser) == sorted(methods(browser), key=str.lower, reverse=True)


def test_rows_of_a_method_stay_together(browser: webdriver.Chrome) -> None:
    press(browser, "table2", "CartPole", times=2)
    found = labels(browser, "table2")
    assert [row[0] for row in found[::2]] == [row[0] for row in found[1::2]]
    assert [row[1] for row in found] == ["AER", "P"] * (len(found) // 2)


def test_settings_are_sorted_within_their_environment(browser: webdriver.Chrome) -> None:
    press(browser, "table6", "AER")
    found = labels(browser, "table6")
    assert [row[1] for row in found[:5]] == ["25", "1", "50", "75", "100"]
    assert [row[0] for row in found[::5]] == ["CartPole", "Acrobot", "MountainCar", "LunarLander"]


def test_a_part_of_the_bar_chooses_its_numbers(browser: webdriver.Chrome) -> None:
    browser.find_element(By.CSS_SELECTOR, ".bar .better").click()
    rows = browser.find_elements(By.CSS_SELECTOR, "#numbers-table tbody tr")
    shown = [row for row in rows if row.is_displayed()]
    assert [row.get_attribute("data-verdict") for row in shown] == ["better"]
    assert browser.find_element(By.CSS_SELECTOR, "#numbers output").text == f"1 of {len(rows)}"


def test_runs_are_found_by_a_word(browser: webdriver.Chrome) -> None:
    field = browser.find_element(By.CSS_SELECTOR, "#runs input[type=search]")
    field.send_keys("mountaincar")
    assert browser.find_element(By.ID, "run-a").is_displayed()
    field.send_keys("nowhere")
    assert not browser.find_element(By.ID, "run-a").is_displayed()


def test_a_link_opens_its_deviation(browser: webdriver.Chrome) -> None:
    browser.execute_async_script(
        "addEventListener('hashchange', () => setTimeout(arguments[0])); location.hash = '#D5'"
    )
    assert browser.find_element(By.ID, "D5").get_property("open")


def copied(browser: webdriver.Chrome) -> tuple[str, str, str]:
    """What a button to copy says then, the command beside it, and what is selected."""
    command = browser.find_element(By.CSS_SELECTOR, "#runs .command")
    button, code = (command.find_element(By.TAG_NAME, tag) for tag in ("button", "code"))
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
    browser.execute_async_script(
        "arguments[0].click(); setTimeout(arguments[arguments.length - 1], 100)", button
    )
    return button.text, code.text, browser.execute_script("return String(getSelection())")


def test_a_command_can_be_copied(browser: webdriver.Chrome) -> None:
    browser.execute_script(
        "Object.defineProperty(navigator, 'clipboard',"
        " {value: {writeText: async (text) => { window.clipboard = text; }}})"
    )
    outcome, command, _ = copied(browser)
    assert outcome == "copied"
    assert browser.execute_script("return window.clipboard") == command


def test_a_command_is_selected_where_the_clipboard_is_closed(browser: webdriver.Chrome) -> None:
    browser.execute_script("Object.defineProperty(navigator, 'clipboard', {value: undefined})")
    outcome, command, selected = copied(browser)
    assert (outcome, selected) == ("selected", command)


def test_a_phone_scrolls_down_only(browser: webdriver.Chrome) -> None:
    emulated(browser, "light", 390)
    script = "return [document.scrollingElement.scrollWidth, innerWidth]"
    assert browser.execute_script(script) == [390, 390]


def test_a_phone_scrolls_wide_tables_in_their_box(browser: webdriver.Chrome) -> None:
    emulated(browser, "light", 390)
    script = """const box = document.querySelector('#table2 .scroll');
        box.scrollLeft = 200;
        return [box.scrollLeft, box.querySelector('tbody th').getBoundingClientRect().left
            - box.getBoundingClientRect().left]"""
    assert browser.execute_script(script) == [200, 0]


def test_light_and_dark_differ(browser: webdriver.Chrome) -> None:
    script = "return getComputedStyle(document.body).backgroundColor"
    light = browser.execute_script(script)
    emulated(browser, "dark", 1280)
    assert browser.execute_script(script) != light


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_stand_out(browser: webdriver.Chrome, scheme: str) -> None:
    emulated(browser, scheme, 1280)
    browser.execute_script(
        "document.querySelectorAll('details').forEach((d) => { d.open = true; })"
    )
    ratios = browser.execute_script(CONTRAST)
    assert len(ratios) > 10
    assert [each for each in ratios if each[0] < 4.5] == []
