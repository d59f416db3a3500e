// The status page: keeps ten seconds of what holod says and draws it.

import { Plot, roundUp } from "./plots.js";

const WINDOW_S = 10; // what the plots over time show
const FIELDS_S = 0.1; // what the plot of colour fields shows
const DRAW_MS = matchMedia("(prefers-reduced-motion: reduce)").matches ? 1000 : 100;
const TEXT_MS = 1000;
const FIELDS_MS = 500; // slow enough to look at
const LOOK_MS = 500;
const SILENT_MS = 3000;
const LOG_LINES = 200;

const at = (id) => document.getElementById(id);
const plots = Object.fromEntries(["pupil", "latency", "stages", "fields"].map((id) => [id, new Plot(at(id))]));
const COLOURS = ["red", "green", "blue"];

// Rows as holod sends them: see daemon/doc/page.md.
const seen = { samples: [], frames: [], fields: [], light: [] };
let newest = { snapshot: null, t: 0 }; // t: the run's time of the newest event, in seconds
let heardAt = 0;
let over = false;
let drawn = { fields: 0, text: 0 };

// ---- what holod says

const stream = new EventSource("events");
stream.addEventListener("open", () => {
  for (const kind of Object.keys(seen)) seen[kind].length = 0;
  at("log").replaceChildren();
  newest = { snapshot: null, t: 0 };
  over = false;
  heard();
});
stream.addEventListener("error", () => {
  if (over) {
    stream.close();
  } else if (stream.readyState === EventSource.CLOSED) {
    tellRefusal();
  } else {
    gone(`No connection to holod since ${clock(heardAt || Date.now())}: it has ended, was killed, or cannot be reached. ` +
      "What is below is what it said last. Look at the lasers themselves.");
  }
});
stream.addEventListener("end", () => {
  over = true;
  gone(`The run ended at ${clock(Date.now())}.`);
});
stream.addEventListener("snapshot", ({ data }) => {
  heard();
  newest.snapshot = JSON.parse(data);
  tellState(newest.snapshot);
  tellFacts(newest.snapshot);
});
stream.addEventListener("batch", ({ data }) => {
  heard();
  const batch = JSON.parse(data);
  for (const kind of Object.keys(seen)) seen[kind].push(...batch[kind]);
  const times = [batch.samples.at(-1)?.[0], batch.frames.at(-1)?.[1], batch.fields.at(-1)?.[3]];
  newest.t = Math.max(newest.t, ...times.filter((t) => t !== undefined));
  tellLog(batch.log);
});

// A browser that is refused does not ask again, and does not say why.
async function tellRefusal() {
  try {
    const answer = await fetch("events");
    if (answer.ok) {
      location.reload();
    } else {
      gone(`holod refuses to be watched: ${(await answer.text()).trim()}. Reload this page to ask again.`);
    }
  } catch {
    gone("holod has refused to be watched, and cannot be reached any more. Look at the lasers themselves.");
  }
}

function heard() {
  heardAt = Date.now();
  if (!over) at("alert").hidden = true;
}

function gone(text) {
  alertText(text);
  at("state").textContent = over ? "ended" : "not connected";
  at("state").dataset.state = "gone";
  at("lasers").textContent = "lasers: not known";
  at("lasers").dataset.lasers = "unknown";
}

function alertText(text) {
  at("alert").textContent = text;
  at("alert").hidden = false;
}

setInterval(() => {
  if (over || stream.readyState !== EventSource.OPEN) return;
  const silent = Date.now() - heardAt;
  if (silent > SILENT_MS) gone(`holod has said nothing for ${Math.round(silent / 1000)} s: it hangs, or this machine does.`);
}, 500);

// ---- words

const clock = (ms) => new Date(ms).toLocaleTimeString();
const number = (value, digits = 1) => (value == null ? "–" : value.toFixed(digits));

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function tellState(snapshot) {
  const { state, lasers } = snapshot;
  document.title = `holod: ${state}`;
  put(at("rig"), snapshot.rig);
  put(at("state"), snapshot.paused ? `${state}, paused` : state);
  at("state").dataset.state = state;
  put(at("lasers"), `lasers: ${lasers}${whyDark(snapshot)}`);
  at("lasers").dataset.lasers = lasers;
}

function whyDark(snapshot) {
  if (snapshot.lasers_kept_dark) return ", by order";
  return snapshot.feed_trouble ? ", no pictures" : "";
}

const camera = ({ focus_dpt: focus, field_of_view_deg: field }) => [
  focus == null ? "" : `focused at ${number(focus, 2)} dpt`,
  field && `${number(field[0])} x ${number(field[1])} degrees`,
].filter(Boolean).join(", ");

const kinds = (counts) => Object.entries(counts).filter(([, count]) => count > 0)
  .map(([kind, count]) => `${count} ${kind.replaceAll("_", " ")}`).join(", ");

function tellFacts(snapshot) {
  const spread = (time) => time && `${number(time.median_ms)} ms median, ${number(time.p99_ms)} ms 99th, ${number(time.max_ms)} ms most`;
  const { feed, record } = snapshot;
  const facts = [
    ["Scene", snapshot.scene],
    ["Pattern", snapshot.pattern && `${snapshot.pattern}, in place of holograms, until holod ctl hologram`],
    ["Weights", snapshot.weights],
    ["Engine", snapshot.engine],
    ["Hologram", snapshot.hologram],
    ["Panel", snapshot.panel],
    ["Panel’s trouble", snapshot.panel_trouble],
    ["Lasers’ trouble", snapshot.lasers_trouble || snapshot.unlit],
    ["Tracker", `${snapshot.tracker}, link ${snapshot.tracker_link}`],
    ["Tracker’s trouble", snapshot.tracker_trouble],
    ["Pupil", `${number(snapshot.pupil_mm, 2)} mm, ${snapshot.pupil_state || "not known yet"}; eye: ${snapshot.eye}`],
    ["Frames shown", `${snapshot.frames_shown}, ${number(snapshot.frames_shown_hz)} a second of ${number(snapshot.panel_frames_hz)}`],
    ["Frames computed", `${snapshot.frames_computed} of ${snapshot.frames_made} made`],
    ["Late frames", String(snapshot.deadline_misses)],
    ["Advice", snapshot.speed_advice],
    ["Frame time", spread(snapshot.frame_time)],
    ["Sample to photons", spread(snapshot.sample_to_photon)],
    ["Picture to photons", spread(snapshot.picture_to_photon)],
    ["Feed", feed && `${feed.shown ?? "nobody’s pictures are shown"}; ${feed.clients.length} clients, ${feed.taken} pictures, ` +
      `${feed.refused} refused${feed.newest_age_s == null ? "" : `, newest ${number(feed.newest_age_s)} s ago`}`],
    ["Feed’s camera", feed && camera(feed.view)],
    ["Feed’s trouble", snapshot.feed_trouble],
    ["Feed’s bad depths", feed?.pictures_with_bad_depths > 0 && `${kinds(feed.bad_depths) || "none"} in the newest picture; ` +
      `${kinds(feed.bad_depths_in_all)} in ${feed.pictures_with_bad_depths} pictures`],
    ["Feed’s clipped colours", feed?.pictures_with_clipped_colours > 0 &&
      `${kinds(feed.clipped_colours) || "none"} in the newest picture; ` +
      `${kinds(feed.clipped_colours_in_all)} in ${feed.pictures_with_clipped_colours} pictures`],
    ["Feed refused", feed?.last_refusal],
    ["Record", record && `${record.state === "lost" ? `lost: ${record.reason}` : record.folder}` +
      `${record.rows_lost ? `; ${record.rows_lost} rows left out: the disk is too slow` : ""}`],
    ["Running for", `${Math.round(snapshot.uptime_s)} s, process ${snapshot.pid}`],
  ].filter(([, value]) => value);
  rows(at("facts"), facts, (list, name, value) => {
    list.append(element("dt", name), element("dd", value));
  });
  const counts = Object.entries(snapshot.tracker_counts).filter(([, count]) => count > 0);
  rows(at("counters"), counts, (table, name, count) => {
    const row = document.createElement("tr");
    row.append(element("td", name.replaceAll("_", " ")), element("td", String(count)));
    table.append(row);
  });
}

function element(kind, text) {
  const made = document.createElement(kind);
  made.textContent = text;
  return made;
}

// Made anew only where something has changed, so that a screen reader does not lose its place.
function rows(parent, entries, add) {
  const key = JSON.stringify(entries);
  if (parent.dataset.key === key) return;
  parent.dataset.key = key;
  parent.replaceChildren();
  for (const [name, value] of entries) add(parent, name, value);
}

function tellLog(lines) {
  if (lines.length === 0) return;
  const log = at("log");
  const atEnd = log.scrollTop + log.clientHeight >= log.scrollHeight - 4;
  for (const { unix_ms, level, text } of lines) {
    const line = element("p", `${clock(unix_ms)} ${level} ${text}`);
    line.className = level;
    log.append(line);
  }
  while (log.childElementCount > LOG_LINES) log.firstElementChild.remove();
  if (atEnd) log.scrollTop = log.scrollHeight;
}

// ---- plots

setInterval(() => {
  forget();
  if (document.hidden || at("still").checked || newest.t === 0) return;
  const now = performance.now();
  drawPupil();
  drawLatency();
  drawStages();
  if (now - drawn.fields >= FIELDS_MS) {
    drawn.fields = now;
    drawFields();
  }
  if (now - drawn.text >= TEXT_MS) {
    drawn.text = now;
    tellFigures();
  }
}, DRAW_MS);

function forget() {
  const t0 = newest.t - WINDOW_S;
  const time = { samples: 0, frames: 1, fields: 3, light: 0 };
  for (const [kind, list] of Object.entries(seen)) {
    const first = list.findIndex((row) => row[time[kind]] >= t0);
    list.splice(0, first < 0 ? list.length : first);
  }
}

function overTime(plot, high, unit, low = 0) {
  const t1 = newest.t, t0 = t1 - WINDOW_S;
  plot.begin({ t0, t1, low, high, unit, ticks: [[t0, `${WINDOW_S} s ago`], [t0 + WINDOW_S / 2, `${WINDOW_S / 2} s`], [t1, "now"]] });
}

function drawPupil() {
  const plot = plots.pupil;
  overTime(plot, 9, "mm", 1);
  seen.frames.forEach(([, t, , state], index) => {
    if (["holding", "fallback", "acquiring"].includes(state)) plot.box(t, seen.frames[index + 1]?.[1] ?? newest.t, 1, 9, "held");
  });
  plot.dots(seen.samples.filter(([, , mm, refused]) => mm !== null && refused === null).map(([t, , mm]) => [t, mm]), "sample");
  // A refused sample may have any number or none: it is drawn at the edge.
  const inside = (mm) => Math.min(Math.max(mm ?? 1, 1.1), 8.9);
  plot.crosses(seen.samples.filter(([, , , refused]) => refused !== null).map(([t, , mm]) => [t, inside(mm)]), "refused");
  plot.line(seen.frames.map(([, t, mm]) => [t, mm]), "estimate", 1);
  plot.end();
}

function drawLatency() {
  const ofKind = (kind) => seen.light.filter((row) => row[kind] !== null).map((row) => [row[0], row[kind]]);
  const both = [[ofKind(1), "estimate"], [ofKind(2), "before"]];
  // A few that took very long, such as those of a tracker that was silent, stand at the upper edge as crosses.
  const usual = quantile(both.flatMap(([points]) => points.map(([, ms]) => ms)), 0.75) ?? 0;
  const high = roundUp(Math.max(10, usual * 2));
  const plot = plots.latency;
  overTime(plot, high, "ms");
  for (const [points, name] of both) {
    plot.dots(points.filter(([, ms]) => ms <= high), name, 3);
    plot.crosses(points.filter(([, ms]) => ms > high).map(([t]) => [t, high * 0.97]), "miss");
  }
  plot.end();
}

/** Milliseconds before, in and after the engine. */
const stagesOf = (frame) => frame.slice(4, 7);

function drawStages() {
  const plot = plots.stages;
  const high = roundUp(Math.max(2, ...seen.frames.map((frame) => stagesOf(frame).reduce((sum, ms) => sum + ms))));
  overTime(plot, high, "ms");
  seen.frames.forEach((frame, index) => {
    const t = frame[1];
    const next = seen.frames[index + 1]?.[1] ?? t + 0.016;
    let from = 0;
    stagesOf(frame).forEach((ms, stage) => {
      plot.box(t, Math.min(next, t + 0.1), from, from + ms, ["before", "engine", "after"][stage]);
      from += ms;
    });
  });
  const late = seen.fields.filter((field) => field[6] === "late");
  plot.crosses(late.map(([, , t]) => [t, high * 0.95]), "miss");
  plot.end();
}

/** Whether a field's mark says why it was dark. */
const isReason = (mark) => !["", "repeated", "late"].includes(mark);

function drawFields() {
  const plot = plots.fields;
  const t1 = seen.fields.at(-1)?.[3] ?? newest.t, t0 = t1 - FIELDS_S;
  const ms = FIELDS_S * 1000;
  const rows = COLOURS.map((name, index) => [2.5 - index, name]);
  plot.begin({ t0, t1, low: 0, high: 3, rows, ticks: [[t0, `${ms} ms`], [t0 + FIELDS_S / 2, `${ms / 2} ms`], [t1, "newest field"]] });
  for (const [, which, from, until, on, off, mark] of seen.fields) {
    if (until < t0) continue;
    const low = 2 - which;
    plot.box(from, until, low + 0.1, low + 0.9, "field");
    if (on !== null && off !== null) plot.box(on, off, low + 0.25, low + 0.75, COLOURS[which]);
    else if (isReason(mark)) plot.box(from, until, low + 0.45, low + 0.55, "miss");
  }
  plot.end();
}

const quantile = (values, share) => values.toSorted((a, b) => a - b)[Math.floor(values.length * share)];
const median = (values) => quantile(values, 0.5);

/** Why light has no latency: none follows a sample or a live picture, which only what is computed does. */
function noLatency(isLit, isComputed) {
  if (!isLit) return `no light in ${WINDOW_S} s`;
  return isComputed ? "the light follows no sample and no live picture" : `nothing new in ${WINDOW_S} s`;
}

function tellFigures() {
  const { samples, frames, light, fields } = seen;
  const refused = samples.filter(([, , , reason]) => reason !== null);
  const reasons = Object.entries(Object.groupBy(refused, ([, , , reason]) => reason)).map(([reason, list]) => `${reason.replaceAll("_", " ")} ${list.length}`);
  const last = frames.at(-1);
  put(at("pupil-text"), `${last ? `${number(last[2], 2)} mm, ${last[3]}; ` : ""}${number(samples.length / WINDOW_S, 0)} samples a second, ` +
    `${refused.length} not believed in ${WINDOW_S} s${reasons.length ? `: ${reasons.join(", ")}` : ""}`);
  const told = ["tracker’s sample", "feed’s picture"].map((since, index) => {
    const values = light.map((row) => row[index + 1]).filter((ms) => ms !== null);
    return values.length ? `${number(median(values))} ms median since the ${since}, ${number(Math.max(...values))} ms at most` : "";
  });
  const computed = frames.filter((frame) => frame[7]);
  put(at("latency-text"), told.filter(Boolean).join("; ") || noLatency(light.length > 0, computed.length > 0));
  const late = new Set(fields.filter((field) => field[6] === "late").map(([frame]) => frame)).size;
  const engine = computed.length ? `${computed.length} of them computed in ${WINDOW_S} s; the engine takes ${number(median(computed.map((frame) => frame[5])))} ms` :
    `none of them computed in ${WINDOW_S} s: there was nothing new`;
  put(at("stages-text"), frames.length ? `${number(frames.length / WINDOW_S)} frames a second, ${engine}; ${late} late on the panel` : "no frame yet");
  const lit = fields.filter((field) => field[5] !== null);
  const dark = [...new Set(fields.filter((field) => field[5] === null).map((field) => field[6]).filter(isReason))];
  const share = fields.length ? lit.reduce((sum, field) => sum + field[5] - field[4], 0) / fields.reduce((sum, field) => sum + field[3] - field[2], 0) : 0;
  put(at("fields-text"), `${lit.length} of ${fields.length} fields lit in ${WINDOW_S} s, ${number(share * 100, 0)} % of the time${dark.length ? `; dark: ${dark.join(", ")}` : ""}`);
}

// ---- the eye

let picture = null;
function tellFocus() {
  const dpt = Number(at("focus").value);
  const text = `${dpt} dpt, ${dpt === 0 ? "infinity" : `${number(100 / dpt, 0)} cm`}`;
  at("focus-text").textContent = text;
  at("focus").setAttribute("aria-valuetext", text);
}
at("focus").addEventListener("input", tellFocus);
tellFocus();

async function look() {
  if (at("look").checked && !document.hidden && !over && stream.readyState === EventSource.OPEN) {
    const pupil = at("eye-pupil").value;
    try {
      const answer = await fetch(`eye.png?focus_dpt=${at("focus").value}${pupil && `&pupil_mm=${pupil}`}`);
      if (answer.ok) show(await answer.blob(), answer.headers);
      else put(at("eye-text"), (await answer.text()).trim());
    } catch {
      // The stream of events says that holod is gone.
    }
  }
  setTimeout(look, LOOK_MS);
}

function show(blob, headers) {
  if (picture) URL.revokeObjectURL(picture);
  picture = URL.createObjectURL(blob);
  const [frame, madeFor, pupil, focus] = ["frame", "made-for-mm", "pupil-mm", "focus-dpt"].map((name) => Number(headers.get(`holod-${name}`)));
  const image = at("eye");
  image.src = picture;
  image.dataset.frame = frame;
  image.alt = `Simulated: a pupil of ${number(pupil, 2)} mm focused at ${focus} dpt`;
  const dark = newest.snapshot?.lasers === "armed" ? "" : " The lasers are dark: this is what they would show.";
  put(at("eye-text"), `Frame ${frame}, made for ${number(madeFor, 2)} mm, seen by ${number(pupil, 2)} mm at ${focus} dpt.${dark}`);
}

look();
