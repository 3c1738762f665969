"""The web page in a real browser: upload, watch, look, download; by keyboard; with names full of HTML.

Needs Playwright and a Chromium; `HSLOC_SCREENSHOTS=DIR` keeps pictures.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote
from xml.etree import ElementTree

import pytest
from live_service import upload
from paths import RECORDINGS

from hsloc_service.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from live_service import Live

pytestmark = pytest.mark.unmeasured

REAL = ",".join(Settings().worker_command)
NASTY = "<img src=x onerror=alert(1)>.mcap"


def picture(page: Any, name: str) -> None:
    folder = os.environ.get("HSLOC_SCREENSHOTS")
    if folder:
        page.screenshot(path=f"{folder}/{name}.png", full_page=True)


MAP, CHART = "#view .rv-base", "#charts .rv-chart canvas"


def inked(page: Any, selector: str) -> int:
    """How many different colours a canvas shows."""
    script = """(s) => { const c = document.querySelector(s); const d = c.getContext('2d').getImageData(
      0, 0, c.width, c.height).data; const found = new Set();
      for (let k = 0; k < d.length; k += 4) found.add(d[k] << 16 | d[k + 1] << 8 | d[k + 2]); return found.size; }"""
    return int(page.evaluate(script, selector))


def test_upload_watch_look_download(
    make_live: Callable[..., Live],
    open_page: Callable[..., Any],
    need_accessible: Callable[[Any], None],
    tmp_path: Path,
) -> None:
    live = make_live(HSLOC_WORKER_COMMAND=REAL, HSLOC_SANDBOX="none", HSLOC_JOB_MEMORY_BYTES="4G")
    log = tmp_path / NASTY
    shutil.copy(RECORDINGS / "office.mcap", log)
    page = open_page(live.url, viewport={"width": 1280, "height": 900})
    picture(page, "1-empty")
    page.set_input_files("#log", str(log))
    look_before_it_runs(page)
    page.click("#go")
    page.wait_for_selector("#job-state .running")
    picture(page, "2-running")
    page.wait_for_selector("#job-state .succeeded", timeout=120_000)
    page.wait_for_selector("#result:not([hidden])", timeout=120_000)
    page.wait_for_function("() => document.querySelector('.rv-now')?.textContent")
    assert page.text_content("#job-title") == NASTY
    assert page.locator("#job img, #jobs img:not([src^='blob:'])").count() == 0  # none of the log's name
    assert inked(page, MAP) > 5
    assert inked(page, CHART) > 3
    assert re.search(r"APE rmse\d+\.\d+ cm / \d+\.\d+°", page.text_content("#metrics") or "")
    assert (page.text_content("#headline") or "").startswith(
        "good Localised on the map of the log: every pose is known"
    )
    assert (page.text_content("#facts") or "").startswith("nothing contradicts the result · localised on the map of")
    assert page.locator("#key-figures div").count() == 3
    picture(page, "3-result")
    assert "verdict: good" in (page.text_content("#job-log pre") or "")
    need_accessible(page)
    share_by_a_link(page, open_page)
    with page.expect_download() as download:
        page.click("text=trajectory.tum")
    assert download.value.suggested_filename == "trajectory.tum"
    with live.client() as client:
        job = client.get("/v1/jobs").json()["jobs"][0]
        assert job["log"] == NASTY
        content = client.get(f"/v1/jobs/{job['id']}/results/trajectory.tum").content
    assert Path(download.value.path()).read_bytes() == content
    look_around_by_keyboard(page)
    look_around_by_mouse(page)
    picture(page, "4-zoomed")
    look_on_a_phone_in_the_dark(page, need_accessible)
    page.wait_for_function("() => location.hash.includes('&t=')")
    first = page.url
    press(page, "#job-buttons button >> text=Run again")
    page.wait_for_function("(first) => location.href !== first", arg=first)
    page.wait_for_selector("#job-state .succeeded", timeout=120_000)
    page.wait_for_selector("#result:not([hidden])", timeout=120_000)
    page.go_back()  # to the first result
    page.wait_for_selector("#result:not([hidden])", timeout=120_000)
    assert page.url == first
    time = first.partition("&t=")[2]  # a link holds the time that was looked at
    page.wait_for_function("(t) => document.querySelector('.rv-now')?.textContent.startsWith(`${t} s`)", arg=time)
    pictures = []
    page.on("download", lambda one: pictures.append(one.suggested_filename))
    with page.expect_download():
        page.click("#view [data-do=picture]")
    drawn(page)
    assert len(pictures) == 1  # those of the results that were shown before are gone
    page.click("text=← all jobs")
    page.wait_for_function("() => document.querySelectorAll('#jobs tbody tr').length === 2")
    page.wait_for_function(
        "() => [...document.querySelectorAll('#jobs img')].filter((e) => e.naturalWidth === 120).length === 2"
    )
    compare_two(page, need_accessible)
    with live.client() as client:
        state_loops_by_two_clicks(page, client)
    report = open_page(f"{live.url}/v1/jobs/{job['id']}/results/report.html?download=false")
    report.wait_for_selector(".rv-now")
    need_accessible(report)


def look_before_it_runs(page: Any) -> None:
    page.click("#inspect")
    page.wait_for_selector("#inspected-map .rv-base")
    assert "scans /scan, odometry /odom, reference /ground_truth; a map" in (page.text_content("#inspected") or "")
    topics = "(control) => [...control.list.options].map((each) => each.value)"
    assert page.locator("[data-option='read.scan_topic']").evaluate(topics) == ["/scan"]
    page.click("#inspected-view [data-do=pose]")
    page.locator("#inspected-view .rv-over").scroll_into_view_if_needed()
    box = page.locator("#inspected-view .rv-over").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 50, y)
    page.mouse.up()
    assert (page.input_value("[data-option=initial_pose]") or "").endswith(", 0.000")
    picture(page, "10-inspected")
    page.evaluate("document.querySelector('[data-option=initial_pose]').value = ''")
    page.evaluate("""document.querySelector('[data-option="read.end_s"]').value = '10'""")


def share_by_a_link(page: Any, open_page: Callable[..., Any]) -> None:
    page.click("summary >> text=Share")
    page.click("#make-share")
    page.wait_for_selector("#shares li")
    link = page.input_value("#share-link")
    page.context.route("https://lichtblick-suite.github.io/**", lambda route: route.fulfill(body="a viewer"))
    page.context.route("https://app.foxglove.dev/**", lambda route: route.fulfill(body="a viewer"))
    with page.expect_popup() as popup:
        page.click("#job-buttons >> text=Open in Foxglove")
    popup.value.wait_for_url(
        re.compile(r"/~/view\?ds=remote-file&ds\.url=http%3A.*%2Fhss_[\w-]{43}%2Fresults%2Frun\.mcap$")
    )
    popup.value.close()
    with page.expect_popup() as popup:
        page.click("#job-buttons >> text=Open in Lichtblick")
    popup.value.wait_for_url(
        re.compile(r"lichtblick/\?ds=remote-file&ds\.url=http%3A.*%2Fhss_[\w-]{43}%2Fresults%2Frun\.mcap$")
    )
    file = unquote(popup.value.url.partition("ds.url=")[2])
    read = """async (file) => { const part = await fetch(file, { headers: { range: "bytes=0-7" } });
      return [part.status, part.headers.get("content-range"), (await part.text()).slice(1, 5)]; }"""
    popup.value.close()
    other = page.context.new_page()  # of no site at all, so that what it reads needs the headers of CORS
    status, span, magic = other.evaluate(read, file)
    assert (status, span.partition("/")[0], magic) == (206, "bytes 0-7", "MCAP")
    other.close()
    visitor = open_page(link)
    visitor.wait_for_function("() => document.querySelector('.rv-now')?.textContent")
    assert visitor.text_content("#job-title") == NASTY
    assert visitor.locator("#job-buttons button").count() == 0
    assert visitor.is_hidden("#job-describe")
    assert visitor.is_hidden("#job-share")
    with visitor.expect_download() as download:
        visitor.click("text=trajectory.tum")
    assert download.value.suggested_filename == "trajectory.tum"
    picture(visitor, "9-shared")
    for left in (2, 1, 0):
        page.click("#shares button")  # revokes
        page.wait_for_function("(n) => document.querySelectorAll('#shares li').length === n", arg=left)
    visitor.close()
    late = page.context.new_page()  # whose console may say 404
    late.goto(link)
    late.wait_for_selector("#notice >> text=revoked")
    assert late.is_hidden("#job")
    late.close()


def compare_two(page: Any, need_accessible: Callable[[Any], None]) -> None:
    for box in page.locator("#jobs tbody input").all():
        box.check()
    page.click("#compare-ticked")
    page.wait_for_selector("#comparison .rv-base")
    picture(page, "8-compare")
    need_accessible(page)
    assert inked(page, "#comparison .rv-base") > 5
    rows = page.locator("#comparison table tr").all_text_contents()
    assert any(re.fullmatch(r"APE rmse(\d+\.\d+ cm / \d+\.\d+°){2}", row) for row in rows)  # the same run: no change
    leave_before_it_is_compared(page)


def state_loops_by_two_clicks(page: Any, client: Any) -> None:
    """On a built map: which two places are one, for the next run."""
    log = client.get("/v1/files").json()["files"][0]["id"]
    built = client.post("/v1/jobs", json={"log": log, "mode": "slam", "read": {"end_s": 3.0}}).json()["id"]
    page.evaluate("(id) => { location.hash = `job=${id}`; }", built)
    page.wait_for_selector("#view [data-do=loop]", timeout=120_000)
    page.click("#view [data-do=loop]")
    assert page.is_disabled("#one-place")
    page.evaluate("document.querySelector('#view').scrollIntoView()")
    box = page.locator("#view .rv-over").bounding_box()
    tried = [(0.05 * column, 0.05 * row) for row in range(1, 20) for column in range(1, 20)]  # wherever the path is
    for across, down in sorted(tried, key=lambda at: abs(at[0] - 0.5) + abs(at[1] - 0.5)):
        if page.is_enabled("#one-place"):
            break
        page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])
    assert re.fullmatch(r"\d\.\d s and \d\.\d s: .*", page.text_content("#state-loops p") or "")
    page.click("#two-places")
    found = page.input_value("#forbid-loop")
    assert len(found.split(",")) == 2
    picture(page, "11-loops")
    page.click("#state-loops >> text=Run again")
    page.wait_for_function("(id) => !location.hash.includes(id)", arg=built)
    again = page.url.partition("job=")[2]
    request = client.get(f"/v1/jobs/{again}").json()["request"]
    assert (request["mode"], request.get("assert_loop")) == ("slam", None)
    assert [float(t) for t in request["forbid_loop"].split(",")] == [float(t) for t in found.split(",")]
    client.post(f"/v1/jobs/{again}/cancel")


def leave_before_it_is_compared(page: Any) -> None:
    """What is compared is not built when the page shows something else by then."""
    page.evaluate("""() => { globalThis.built = 0; const made = globalThis.ResultComparison;
      globalThis.ResultComparison = class extends made { constructor(...all) { super(...all); built += 1; } }; }""")
    held: list[Any] = []
    page.route("**/viewer.json", lambda route: route.continue_() if held else held.append(route))
    address = page.url
    page.evaluate("location.hash = 'job=../info'")  # no id of a job: the page begins with the table
    page.wait_for_selector("#home:not([hidden])")
    with page.expect_request("**/viewer.json"):
        page.evaluate("(address) => { location.href = address; }", address)
    page.evaluate("location.hash = ''")
    page.wait_for_selector("#home:not([hidden])")
    with page.expect_response("**/viewer.json"):
        held[0].continue_()
    page.wait_for_timeout(300)
    assert page.evaluate("built") == 0
    page.unroute("**/viewer.json")


def drawn(page: Any, selector: str = MAP) -> str:
    """What a canvas shows, when the requested frame is drawn."""
    script = """(s) => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(
      () => done(document.querySelector(s).toDataURL()))))"""
    return str(page.evaluate(script, selector))


def press(page: Any, selector: str) -> None:
    """Come to a control by Tab alone, and press Enter."""
    target = page.locator(selector).first
    for _ in range(80):
        page.keyboard.press("Tab")
        if target.evaluate("(e) => e === document.activeElement"):
            break
    assert target.evaluate("(e) => e === document.activeElement && e.matches(':focus-visible')")
    page.keyboard.press("Enter")


def look_around_by_keyboard(page: Any) -> None:
    page.focus("#view .rv-over")
    page.keyboard.press("0")
    whole = seen = drawn(page)
    for key in ("+", "ArrowLeft", "ArrowDown", "-"):
        page.keyboard.press(key)
        assert drawn(page) != seen, key
        seen = drawn(page)
    page.keyboard.press("0")
    assert drawn(page) == whole
    now, over = page.text_content(".rv-now"), drawn(page, "#view .rv-over")
    page.keyboard.press(".")
    assert page.text_content(".rv-now") != now
    assert drawn(page, "#view .rv-over") != over  # robot and scan have moved
    assert drawn(page) == whole  # and nothing else has
    page.keyboard.press(",")
    assert page.text_content(".rv-now") == now
    page.focus("#view input[type=range]")
    page.keyboard.press("End")
    assert (page.text_content(".rv-now") or "").startswith("10.0 s")
    page.keyboard.press("Home")
    assert (page.text_content(".rv-now") or "").startswith("0.0 s")
    page.select_option("#view [data-do=speed]", "5")
    page.click("#view [data-do=play]")
    page.wait_for_function("() => parseFloat(document.querySelector('.rv-now').textContent) > 1.0")
    page.click("#view [data-do=play]")
    stopped = page.text_content(".rv-now")
    page.wait_for_timeout(200)
    assert page.text_content(".rv-now") == stopped
    with page.expect_download() as download:
        press(page, "#assets button >> text=metrics.json")
    assert download.value.suggested_filename == "metrics.json"


def look_around_by_mouse(page: Any) -> None:
    page.click("#view [data-do=all]")
    whole = drawn(page)
    page.locator("#view .rv-over").scroll_into_view_if_needed()
    page.focus("#view .rv-over")
    box = page.locator("#view .rv-over").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.wheel(0, -400)
    page.wait_for_function("([s, seen]) => document.querySelector(s).toDataURL() !== seen", arg=[MAP, whole])
    zoomed = drawn(page)
    page.mouse.down()
    page.mouse.move(x + 80, y + 40)
    page.mouse.up()
    moved = drawn(page)
    assert moved != zoomed
    page.uncheck("#view [data-layer=odometry]")
    assert drawn(page) != moved
    by_time = drawn(page)
    page.select_option("#view [data-do=colour]", "error")
    assert drawn(page) != by_time
    now = page.text_content(".rv-now")
    page.locator("#charts .rv-plot").first.click()  # a click on a curve seeks
    assert page.text_content(".rv-now") != now
    for button, ending in (("picture", ".png"), ("drawing", ".svg")):
        with page.expect_download() as download:
            page.click(f"#view [data-do={button}]")
        assert download.value.suggested_filename.endswith(ending)
    drawing = ElementTree.parse(download.value.path()).getroot()
    assert drawing.findall(".//{*}path[@stroke-width]")
    assert [each.text for each in drawing.findall(".//{*}text")][:2] == ["end", "start"]
    seen = drawn(page)
    page.check("#view [data-layer=heat]")
    assert drawn(page) != seen
    page.uncheck("#view [data-layer=heat]")
    page.check("#view [data-layer=coverage]")
    assert drawn(page) != seen
    assert re.search(r"scans that saw a place: 1 10 \d\d+ · without", page.text_content("#view .rv-layers") or "")
    page.hover("#view .rv-over")
    assert re.search(r"· seen by \d+ scans|· never seen", page.text_content("#view .rv-place") or "")
    page.uncheck("#view [data-layer=coverage]")
    drag_a_start_pose(page, x, y)


def drag_a_start_pose(page: Any, x: float, y: float) -> None:
    """An arrow on the map: its tail is the position, its direction the heading."""
    page.click("#view [data-do=pose]")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 60)
    page.mouse.up()
    assert re.search(r"start at x -?\d+\.\d\d m, y -?\d+\.\d\d m, 90\.0°", page.text_content("#start-here") or "")
    page.click("#start-here >> text=Cancel")
    assert page.is_hidden("#start-here")


def look_on_a_phone_in_the_dark(page: Any, need_accessible: Callable[[Any], None]) -> None:
    ground = "getComputedStyle(document.documentElement).backgroundColor"
    light, map_in_light = page.evaluate(ground), drawn(page)
    page.emulate_media(color_scheme="dark")
    assert page.evaluate(ground) != light
    page.wait_for_function("([s, seen]) => document.querySelector(s).toDataURL() !== seen", arg=[MAP, map_in_light])
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.locator(MAP).bounding_box()["width"] > 300
    picture(page, "7-phone-result")
    need_accessible(page)
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1280, "height": 900})


def test_on_a_phone_in_the_dark_by_keyboard_and_cancel(
    make_live: Callable[..., Live], open_page: Callable[..., Any]
) -> None:
    live = make_live()
    with live.client() as client:
        file = upload(client, b"slow 300", NASTY)
        client.post("/v1/jobs", json={"log": file})
    options = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "color_scheme": "dark"}
    page = open_page(live.url, **options)
    page.wait_for_selector("#jobs [data-job]")
    for _ in range(30):
        if page.evaluate("document.activeElement.dataset.job !== undefined"):
            break
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_selector("#job-state .running")
    page.wait_for_function("() => document.querySelector('#job-state').textContent.includes('replay')")
    far = page.evaluate("document.querySelector('#job-bar').value")
    page.wait_for_function("(far) => document.querySelector('#job-bar').value > far", arg=far)  # without a reload
    picture(page, "5-phone")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")  # nothing sticks out
    press(page, "#job-buttons button >> text=Cancel")
    page.wait_for_selector("#job-state .cancelled")
    picture(page, "6-phone-cancelled")
