// What is in the chosen log, before it is run: topics to pick from, findings, and the map, on which an arrow sets the start.

import { $, duration, element, list } from "./dom.js";

const TYPES = { "read.scan_topic": /Scan|PointCloud|Echo/i, "read.odom_topic": /Odometry|JointState|TFMessage|FrameTransform|Twist/i, "read.truth_topic": /Pose|Odometry|TFMessage|Transform/i };
let map = null, topics = [];

// Offers the topics of the log that was looked at in the form, which may be made only after that.
export function offerTopics() {
  for (const [option, types] of Object.entries(TYPES)) {
    const control = document.querySelector(`[data-option="${option}"]`);
    if (!control) continue;
    const id = `${control.id}-topics`, choices = $(id) ?? document.createElement("datalist");
    choices.id = id;
    choices.replaceChildren(...topics.filter((topic) => types.test(topic.type)).map((topic) => new Option(`${topic.type}, ${topic.count} messages`, topic.topic)));
    control.after(choices);
    control.setAttribute("list", id);
  }
}

async function showMap(found) {
  map?.end();
  map = null;
  $("inspected-map").hidden = !found.view;
  if (!found.view) return;
  const image = new Image();
  image.src = found.map_image;
  await image.decode();
  map = new globalThis.ResultView($("inspected-view"), found.view, image, document.createElement("div"));
  map.offerPose("set the start pose: drag an arrow");
  if (found.initial_pose) {
    const [x, y, yaw] = found.initial_pose, tail = map.local(x, y);
    map.setPose([tail, [tail[0] + 1.5 * Math.cos(yaw), tail[1] + 1.5 * Math.sin(yaw)]]);
  }
}

export async function show(found) {
  const box = $("inspected"), read = [["scans", found.scan_topic], ["odometry", found.odom_topic], ["reference", found.truth_topic]];
  const summary = `${duration(found.duration_s)}, ${found.format}: ${read.map(([what, topic]) => `${what} ${topic ?? "none"}`).join(", ")}; ${found.view ? "a map" : "no map: one will be built"}`;
  const findings = (found.findings ?? []).map((each) => [`${each.severity}: ${each.topic ? `${each.topic}: ` : ""}${each.text}${each.count > 1 ? ` (${each.count} times)` : ""}${each.remedy ? `; ${each.remedy}` : ""}`, each.severity]);
  const verdict = found.findings === null ? "not checked: the log is larger than 1 GB" : findings.length ? "" : "nothing is wrong with it";
  const listed = element("details"), table = element("table");
  for (const topic of found.topics) {
    const row = table.insertRow();
    for (const text of [topic.topic, topic.type, `${topic.count} messages`, `${topic.rate_hz.toFixed(1)} Hz`]) row.insertCell().textContent = text;
  }
  listed.append(element("summary", `${found.topics.length} topics`), table);
  box.replaceChildren(element("p", summary), ...(verdict ? [element("p", verdict, "quiet")] : []),
    ...list("Check", findings), ...list("Warnings", found.warnings.map((text) => [text])), listed);
  box.hidden = false;
  topics = found.topics;
  offerTopics();
  await showMap(found);
}

export function hide() {
  $("inspected").hidden = $("inspected-map").hidden = true;
  map?.end();
  map = null;
}

export function listen() {
  $("inspected-view").addEventListener("pose", ({ detail: [x, y, yaw] }) => {
    const text = [x, y, yaw].map((value) => value.toFixed(3)).join(", "), control = document.querySelector("[data-option=initial_pose]");
    if (control) control.value = text;
    $("inspected-pose").textContent = `start pose: ${text}`;
  });
}
