"use strict";
// Dates: a time is a number of `length` milliseconds since `start`, and is shown as the clocks of a zone show it.
const switchfitDates = (() => {
  const SECOND = 1e3, MINUTE = 6e4, HOUR = 36e5, DAY = 864e5, MONTH = 30.44 * DAY;
  const STEPS = [
    ...[1, 2, 5, 10, 20, 50, 100, 200, 500], ...[1, 2, 5, 10, 15, 30].map((n) => n * SECOND),
    ...[1, 2, 5, 10, 15, 30].map((n) => n * MINUTE), ...[1, 2, 3, 6, 12].map((n) => n * HOUR),
    ...[1, 2, 7, 14].map((n) => n * DAY),
  ];
  const MONTHS = [1, 2, 3, 6, 12, 24, 60, 120, 240, 600];
  const NAMES = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];
  const formats = new Map();
  const pad = (number, size = 2) => String(number).padStart(size, "0");

  // What the clocks of a zone show, as milliseconds since 1970.
  function wall(ms, zone) {
    if (!formats.has(zone)) {
      const two = "2-digit";
      formats.set(zone, new Intl.DateTimeFormat("en-GB", {
        timeZone: zone, hourCycle: "h23", year: "numeric", month: two, day: two, hour: two, minute: two, second: two,
      }));
    }
    const whole = Math.floor(ms / SECOND) * SECOND;
    const at = Object.fromEntries(formats.get(zone).formatToParts(new Date(whole)).map((p) => [p.type, Number(p.value)]));
    return Date.UTC(at.year, at.month - 1, at.day, at.hour, at.minute, at.second) + ms - whole;
  }

  function unwall(shown, zone) {
    const near = 2 * shown - wall(shown, zone);
    return shown - (wall(near, zone) - near);
  }

  function findTicks(from, to, start, length, zone) {
    const [low, high] = [from, to].map((time) => wall(start + time * length, zone));
    if (!(high > low)) return [];
    const least = (high - low) / 7;
    const step = STEPS.find((one) => one >= least);
    const places = [];
    if (step) {
      const first = step >= 7 * DAY ? 4 * DAY : 0;  // 5 January 1970 was a Monday
      for (let k = Math.ceil((low - first) / step); first + k * step <= high; k += 1) places.push(first + k * step);
    } else {
      const months = MONTHS.find((one) => one * MONTH >= least) || 1200;
      const [begin, end] = [low, high].map((ms) => new Date(ms)).map((d) => 12 * d.getUTCFullYear() + d.getUTCMonth());
      for (let k = Math.ceil(begin / months); k * months <= end; k += 1) {
        const shown = Date.UTC(Math.floor((k * months) / 12), (k * months) % 12, 1);
        if (shown >= low) places.push(shown);
      }
    }
    return places.map((shown) => (unwall(shown, zone) - start) / length);
  }

  // The label of a tick: what differs from its neighbours, and below the first one what they share.
  function label(tick, ticks, start, length, zone) {
    const step = ticks.length > 1 ? Math.abs(ticks[1] - ticks[0]) * length : DAY;
    const date = new Date(Math.round(wall(start + tick * length, zone)));
    const [year, day] = [date.getUTCFullYear(), `${date.getUTCDate()} ${NAMES[date.getUTCMonth()]}`];
    const first = tick === ticks[0];
    if (step >= 27 * DAY) return first || date.getUTCMonth() === 0 ? `${NAMES[date.getUTCMonth()]}\n${year}` : NAMES[date.getUTCMonth()];
    if (step >= 0.9 * DAY) return first ? `${day}\n${year}` : day;
    const clock = `${pad(date.getUTCHours())}:${pad(date.getUTCMinutes())}`;
    const seconds = step < 0.9 * MINUTE ? `:${pad(date.getUTCSeconds())}` : "";
    const finer = step < 0.9 * SECOND ? `.${pad(date.getUTCMilliseconds(), 3)}` : "";
    if (clock === "00:00" && !first && !seconds) return day;
    return first ? `${clock}${seconds}${finer}\n${day} ${year}` : `${clock}${seconds}${finer}`;
  }

  // A date to the place that a step in the unit of the times needs.
  function show(time, step, start, length, zone) {
    const place = step * length < SECOND ? 1 : step * length < MINUTE ? SECOND : MINUTE;
    const date = new Date(Math.round(wall(start + time * length, zone) / place) * place);
    const day = `${date.getUTCFullYear()}-${pad(date.getUTCMonth() + 1)}-${pad(date.getUTCDate())}`;
    const seconds = step * length < MINUTE ? `:${pad(date.getUTCSeconds())}` : "";
    const finer = step * length < SECOND ? `.${pad(date.getUTCMilliseconds(), 3)}` : "";
    return `${day} ${pad(date.getUTCHours())}:${pad(date.getUTCMinutes())}${seconds}${finer}`;
  }

  return { findTicks, label, show };
})();
window.switchfitDates = switchfitDates;

(() => {
  const payload = JSON.parse(document.getElementById("payload").textContent);
  const documents = new Map(); // name of a figure -> Bokeh document
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const coarse = window.matchMedia("(pointer: coarse)").matches;

  // --- figures -------------------------------------------------------------------------------------------------------

  function paint(root) {
    const style = getComputedStyle(document.documentElement);
    const [page, ink, muted, faint] = ["page", "ink", "muted", "faint"].map((name) =>
      style.getPropertyValue(`--${name}`).trim());
    const tagged = { ink, muted, faint, edge: page };
    for (const model of root.references()) {
      if (model.type === "Figure") {
        model.border_fill_color = page;
        if (coarse) model.toolbar.active_drag = null; // a finger scrolls the page
      } else if (model.type.endsWith("Axis")) {
        model.setv({
          axis_line_color: muted, major_tick_line_color: muted, minor_tick_line_color: null,
          major_label_text_color: ink, axis_label_text_color: ink, axis_label_text_font_style: "normal",
        });
      } else if (model.type === "Grid") {
        model.grid_line_color = faint;
      } else if (model.type === "Legend") {
        model.setv({
          label_text_color: ink, background_fill_color: null, border_line_color: null, inactive_fill_color: page,
          label_text_font_size: "12px", padding: 2, margin: 0, spacing: 12,
        });
      }
      for (const tag of model.tags) {
        const colour = tagged[tag];
        if (colour === undefined) continue;
        for (const name of tag === "edge" ? ["line_color"] : ["line_color", "fill_color", "text_color"]) {
          if (!(name in model)) continue;
          const now = model[name];
          if (now === null || (typeof now === "object" && now.value == null)) continue;
          model[name] = typeof now === "object" ? { value: colour } : colour;
        }
      }
    }
  }

  // Put numbers into a copy of a drawing, by the names of its sources and ranges.
  function fill(part, figure) {
    if (Array.isArray(part)) return part.map((entry) => fill(entry, figure));
    if (part === null || typeof part !== "object") return part;
    const copy = Object.fromEntries(Object.entries(part).map(([key, value]) => [key, fill(value, figure)]));
    const name = part.type === "object" && part.attributes && part.attributes.name;
    if (name && figure.sources[name]) {
      copy.attributes.data = { type: "map", entries: figure.sources[name].entries };
    }
    if (name && figure.ranges[name]) Object.assign(copy.attributes, figure.ranges[name]);
    return copy;
  }

  async function embed(name, figure) {
    if (documents.has(name)) return;
    documents.set(name, null);
    const views = await Bokeh.embed.embed_item(fill(payload.templates[figure.template], figure), name);
    const root = [...views.roots][0].model;
    paint(root);
    documents.set(name, root.document);
    document.getElementById(name).closest(".run")?.querySelectorAll("[data-channel]").forEach(switchChannel);
  }

  // Drawings that nothing moves, as compressed SVG.
  async function unpack(name, packed) {
    const image = document.getElementById(name);
    const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
    const text = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
    image.src = `data:image/svg+xml,${encodeURIComponent(text)}`;
    await image.decode();
  }

  function repaint() {
    for (const doc of documents.values()) if (doc) doc.roots().forEach(paint);
  }
  dark.addEventListener("change", repaint);

  // --- runs ----------------------------------------------------------------------------------------------------------

  async function show(choice) {
    for (const element of document.querySelectorAll(".run")) {
      element.classList.toggle("shown", choice === "all" || element.dataset.run === choice);
    }
    const chosen = choice === "all" ? Object.keys(payload.runs) : [choice];
    for (const run of chosen) await embed(`run-${run}`, payload.runs[run]);
  }

  function switchChannel(box) {
    const doc = documents.get(`run-${box.closest(".run").dataset.run}`);
    if (doc) doc.get_model_by_name(`channel-${box.dataset.channel}`).visible = box.checked;
  }
  for (const box of document.querySelectorAll("[data-channel]")) {
    box.addEventListener("change", () => switchChannel(box));
  }

  // --- start ---------------------------------------------------------------------------------------------------------

  window.addEventListener("beforeprint", () => {
    for (const details of document.querySelectorAll("details")) details.open = true;
  });
  const chooser = document.getElementById("run");
  if (chooser) chooser.addEventListener("change", () => show(chooser.value));
  (async () => {
    await show("0");
    for (const [name, packed] of Object.entries(payload.drawings)) await unpack(name, packed);
    document.documentElement.dataset.ready = "true";
  })();
})();
