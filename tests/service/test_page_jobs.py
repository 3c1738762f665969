"""The page's form, its table of jobs and its uploads, in a real browser; see test_page.py."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest
from live_service import submit, wait
from paths import RECORDINGS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from live_service import Live

pytestmark = pytest.mark.unmeasured


def test_the_form_offers_what_the_server_does(
    make_live: Callable[..., Live], open_page: Callable[..., Any], need_accessible: Callable[[Any], None]
) -> None:
    live = make_live()
    page = open_page(live.url)
    page.wait_for_selector("[data-option=seed]", state="attached")
    with live.client() as client:
        offered = {each["name"] for each in client.get("/v1/options", timeout=60.0).json()["run"]}
    built = set(page.evaluate("() => [...document.querySelectorAll('[data-option]')].map((e) => e.dataset.option)"))
    assert built == offered - {"map", "align_to", "relations", "reference", "calibration", "resume"}
    page.click("summary >> text=Map and options")
    for group in ("reading the log", "algorithms"):
        page.click(f"summary >> text={group}")
    need_accessible(page)
    page.fill("[data-option=initial_pose]", "-1, 2, 0.5")
    page.fill("[data-option='read.start_s']", "1.5")
    page.fill("[data-option=seed]", "7")
    page.select_option("[data-option=matcher]", "icp")
    page.fill("[data-option=config]", "icp.iterations=9")
    page.set_input_files("#log", str(RECORDINGS / "slip.mcap"))
    plan = [{"name": f"plan.{kind}", "mimeType": "application/x-plan", "buffer": b"a plan"} for kind in ("png", "yaml")]
    page.set_input_files("#align_to", plan)
    page.click("#go")
    page.wait_for_selector("#job-state .state")
    with live.client() as client:
        (job,) = client.get("/v1/jobs").json()["jobs"]
        request = job["request"]
        parts = {part: client.get(f"/v1/files/{ident}").json()["name"] for part, ident in request["align_to"].items()}
    assert parts == {"yaml": "plan.yaml", "image": "plan.png"}
    assert (request["initial_pose"], request["read"]["start_s"], request["seed"]) == ([-1.0, 2.0, 0.5], 1.5, 7)
    assert (request["matcher"], request["config"]) == ("icp", {"icp": {"iterations": 9}})


def test_several_logs_are_several_jobs_or_one_and_the_table_finds_them(
    make_live: Callable[..., Live],
    open_page: Callable[..., Any],
    need_accessible: Callable[[Any], None],
    tmp_path: Path,
) -> None:
    live = make_live()
    logs = [tmp_path / f"{name}.log" for name in ("alpha", "beta", "gamma")]
    for log in logs:
        log.write_bytes(b"ok")
    page = open_page(live.url)
    page.set_input_files("#log", [str(log) for log in logs])
    page.click("#go")
    page.wait_for_function("() => document.querySelectorAll('#jobs [data-state=succeeded]').length === 3")
    page.check("input[value=parts]")
    page.click("#go")
    page.wait_for_selector("#job-state .state")
    with live.client() as client:
        jobs = client.get("/v1/jobs").json()["jobs"]
    assert [len(job["request"].get("logs") or ()) for job in jobs] == [3, 0, 0, 0]
    page.go_back()
    page.fill("#search", "BET")
    page.wait_for_function("() => document.querySelectorAll('#jobs tbody tr').length === 2")
    assert page.locator("#jobs tbody .name").last.text_content() == "beta.log"  # and the run of three parts
    page.fill("#search", "")
    page.select_option("#order", "name")
    page.wait_for_function("() => document.querySelector('#jobs tbody .name').textContent.startsWith('alpha')")
    name_and_label(page)
    page.select_option("#filter", "state=failed")
    page.wait_for_function("() => document.querySelector('#page-text').textContent === 'no such job'")
    page.click("nav >> text=Uploads")
    page.wait_for_function(r"() => /^They take .* of .*\.$/.test(document.querySelector('#quota').textContent)")
    page.wait_for_function("() => document.querySelectorAll('#file-table tbody tr').length === 3")
    need_accessible(page)
    page.evaluate("location.hash = 'label=100%'")  # no label of a job, and not written as addresses are
    page.wait_for_function("() => document.querySelector('#page-text').textContent === 'no such job'")
    page.evaluate("location.hash = 'shared=hss_cut'")
    page.wait_for_selector("#notice >> text=there is nothing at #shared=hss_cut")
    page.select_option("#label-filter", "")
    page.go_back()
    page.go_back()
    page.focus(".skip")
    page.keyboard.press("Enter")  # skips to the content, and leaves the part that is shown
    assert page.evaluate("[document.activeElement.id, location.hash]") == ["main", "#files"]
    assert page.get_attribute("nav [href='#files']", "aria-current") == "page"
    page.click("#file-table button >> nth=0")  # used again, without an upload
    page.wait_for_function("() => document.querySelector('#stored').value !== ''")
    page.set_input_files("#log", [])
    page.click("#go")
    page.wait_for_selector("#job-state .state")
    with live.client() as client:
        assert len(client.get("/v1/jobs").json()["jobs"]) == 5
        assert len(client.get("/v1/files").json()["files"]) == 3
    page.go_back()
    page.wait_for_selector("#home:not([hidden])")
    page.select_option("#stored", "")
    page.set_input_files("#log", [str(log) for log in logs[:2]])
    page.check("input[value=jobs]")
    page.click("summary >> text=Sweep: every log")
    page.fill("#sweep-seeds", "0-1, 5")
    page.fill("#sweep-configs", "few: hide.budget=100\nmany: hide.buget=800")
    page.click("#go")
    page.wait_for_function("() => document.querySelector('#notice').textContent.includes('no hide.buget')")
    page.fill("#sweep-configs", "few: hide.budget=100\nmany:")
    page.fill("[list=sweep-configs-names]", "hide.budget")
    assert "240 by default; it must be a whole number from 1." in (
        page.text_content("#sweep-options [role=status]") or ""
    )
    page.keyboard.press("Enter")  # adds it with its default, which is selected
    page.keyboard.type("800")
    assert page.input_value("#sweep-configs") == "few: hide.budget=100\nmany: hide.budget=800"
    page.click("#go")
    page.wait_for_function("() => document.querySelectorAll('#matrix .succeeded').length === 12", timeout=120_000)
    assert page.locator("#matrix thead th").all_text_contents() == ["few", "many"]
    assert page.locator("#matrix tbody th").all_text_contents() == ["alpha", "beta", "all logs"]
    if folder := os.environ.get("HSLOC_SCREENSHOTS"):
        page.screenshot(path=f"{folder}/11-sweep.png", full_page=True)
    need_accessible(page)
    page.click("#matrix a >> nth=0")
    page.wait_for_selector("#job-state .succeeded")


def name_and_label(page: Any) -> None:
    """Of alpha.log, the first in the table by name; the whole table by one label; and back to the filters of before."""
    page.locator("#jobs tbody .name").first.click()
    page.wait_for_selector("#job-state .succeeded")
    page.click("summary >> text=Name, labels and notes")
    page.fill("#title", "<b>Hall</b> 3")
    page.fill("#labels", "rain, floor 2,rain")
    page.fill("#notes-text", "people at the door")
    page.click("#describe button")
    page.wait_for_selector("text=saved")
    assert (page.text_content("#job-title") or "").startswith("<b>Hall</b> 3")
    page.click("#job-labels >> text=floor 2")
    page.wait_for_function("() => document.querySelectorAll('#jobs tbody tr').length === 1")
    assert (page.input_value("#label-filter"), page.url.rpartition("#")[2]) == ("floor 2", "label=floor%202")
    page.select_option("#label-filter", "")
    page.wait_for_function("() => document.querySelectorAll('#jobs tbody tr').length > 2")
    page.check("#tick-all")
    assert page.text_content("#ticked-text") == f"{page.locator('#jobs tbody tr').count()} selected"
    page.uncheck("#tick-all")
    assert page.is_hidden("#ticked")
    for box in page.locator("#jobs tbody input").all()[:2]:
        box.check()
    page.fill("#ticked-label", "night")
    page.click("#label-ticked")
    page.wait_for_function("() => document.querySelectorAll('#jobs tbody .label').length === 4")


def test_a_page_goes_on_when_the_server_was_restarted(make_live: Callable[..., Live], browser: Any) -> None:
    live = make_live()
    context = browser.new_context()
    page = context.new_page()  # refused connections are in the console, as they should be
    page.goto(live.url)
    page.wait_for_selector("#jobs", state="attached")
    with live.client() as client:
        job = submit(client, b"held-first")
    page.evaluate(f"location.hash = 'job={job}'")
    page.wait_for_selector("#job-state .running")
    assert live.end() == 0  # the stream ends in good order, and the job does not
    page.wait_for_selector("#offline >> text=The server does not answer")
    live.start()
    page.wait_for_selector("#job-state .succeeded", timeout=120_000)
    assert page.is_hidden("#offline")
    context.close()


def test_an_idle_page_pulls_almost_nothing(make_live: Callable[..., Live], open_page: Callable[..., Any]) -> None:
    live = make_live()
    with live.client() as client:
        for seed in range(4):
            submit(client, seed=seed, config={"hide": {"budget": 250 + seed}})
        for job in client.get("/v1/jobs").json()["jobs"]:
            wait(client, job["id"])
    page = open_page(live.url)
    page.wait_for_function("() => document.querySelectorAll('#jobs [data-state=succeeded]').length === 4")
    with page.expect_response(lambda answer: answer.status == 304):
        pass
    answers: list[Any] = []
    page.on("response", lambda answer: answers.append(answer))
    for _ in range(2):
        with page.expect_response("**"):
            pass
    assert len(answers) >= 2
    assert {answer.status for answer in answers} == {304}


SPARSE = """() => {
  const root = document.createElement("div"); root.className = "rv rv-charts"; document.body.append(root);
  const t = [...Array(50).keys()], fill = (v) => t.map((k) => k % 10 ? null : v);
  const seen = (v) => { root.replaceChildren(); const chart = { title: "a", unit: "m",
      explanation: "", t, v, time: true, log: false, top: null };
    ResultCharts(root, { end: 50, charts: [chart], status: [], lost: [] }, () => {}).draw();
    return root.querySelector("canvas").toDataURL(); };
  return seen(fill(0.5)) !== seen(fill(0.5).map((v, k) => k === 20 ? null : v)); }"""


# A robot that drove 3 m along x of the place in which it was searched for, with a jump after the first pose.
PLACES = """async () => {
  const root = document.createElement("div"), charts = document.createElement("div"), found = [];
  root.style.width = "600px"; document.body.append(root, charts);  // the page goes on
  const t = [0, 1, 2, 3, 4], x = [9, 1, 2, 3, 4], y = [9, 0, 0, 0, 0], theta = [0, 0, 0, 0, 0];
  const trajectory = { t, x, y, theta, breaks: [1], state: [0, 0, 0, 0, 0], states: ["ambiguous"] };
  const place = { begin: 0, end: 4, at: 4, x: [4, 7], y: [0, 5], theta: [0, Math.PI / 2], p: [0.5, 0.5],
      labels: ["a", "b"] };
  const data = { extent: [0, -1, 10, 6], end: 4, trajectory, events: [], marks: [], charts: [], status: [], lost: [],
      ambiguities: [place] };
  const view = new ResultView(root, data, null, charts);
  root.addEventListener("pose", (event) => found.push(event.detail));
  const click = ([px, py]) => {
    const box = view.$over.getBoundingClientRect();
    const at = { clientX: box.x + px / view.ratio, clientY: box.y + py / view.ratio, pointerId: 1, bubbles: true };
    view.$over.setPointerCapture = () => {};
    for (const kind of ["pointerdown", "pointerup"]) view.$over.dispatchEvent(new PointerEvent(kind, at));
  };
  const clickAll = () => view.placeMarks().forEach(({ middle }) => click(middle));
  clickAll();  // a report runs nothing
  view.offerPose(""); clickAll();
  view.move(40, -30); click(view.placeMarks()[0].middle);
  view.end();
  return found.map((pose) => pose.map((value) => Math.round(1000 * value) / 1000 + 0)); }"""


# A map that is panned over several tiles, against the same drawn at once: the share of values that differ.
TILES = """async () => {
  const root = document.createElement("div"), frame = () => new Promise(requestAnimationFrame);
  root.style.width = "600px"; document.body.append(root);
  const t = [...Array(500).keys()], x = t.map((k) => 50 + 40 * Math.cos(k / 20)), y = t.map((k) => 50 + k / 20);
  const trajectory = { t, x, y, theta: t, breaks: [], state: t.map(() => 0), states: ["localised"] };
  const data = { extent: [0, 0, 100, 100], end: 500, trajectory, events: [], charts: [], status: [], lost: [],
      marks: [{ status: "rejected", label: "refused", t, x, y, reason: t }],
      loops: { t: [9, 9], x0: [0, 0], y0: [20, 80], x1: [90, 90], y1: [20, 80], accepted: [true, false],
        reason: ["", "too far"] } };
  const view = new ResultView(root, data, null, document.createElement("div"));
  const values = () => {
    const { width, height } = view.$base;
    return view.$base.getContext("2d").getImageData(0, 0, width, height).data; };
  view.zoom(8); view.drawNow();
  const before = values();
  for (let k = 0; k < 30; k += 1) { view.move(-29, -12); await frame(); await frame(); }
  const panned = values();
  view.drawNow();
  const whole = values();
  const share = (other) => whole.reduce((n, v, k) => n + (Math.abs(v - other[k]) > 64), 0) / whole.length;
  view.all(); view.shown.add("refused");
  const reasons = [20, 80, 5].map((y) => view.reasonAt(...view.pixels(...view.local(30, y))));
  view.end();
  return [share(before), share(panned), ...reasons]; }"""


def test_curves_of_single_values_places_that_may_be_right_and_tiles(
    make_live: Callable[..., Live], open_page: Callable[..., Any]
) -> None:
    page = open_page(make_live().url)
    assert page.evaluate(SPARSE)
    assert page.evaluate(PLACES) == [[1, 0, 0], [7, 2, 1.571], [1, 0, 0]]
    moved, differing, *reasons = page.evaluate(TILES)
    assert reasons == ["loop closed", "loop refused: too far", None]
    assert moved > 0.005
    assert differing < 0.01 * moved
