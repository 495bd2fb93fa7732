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
  const sliders = payload.sliders;
  const known = (value) => (value === null ? NaN : value); // JSON has no NaN
  const documents = new Map(); // name of a figure -> Bokeh document
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const coarse = window.matchMedia("(pointer: coarse)").matches;
  const moved = sliders.map(() => 0);
  let last = 0;

  // --- figures -------------------------------------------------------------------------------------------------------

  function paint(root, name) {
    const style = getComputedStyle(document.documentElement);
    const [page, ink, muted, faint, panel] = ["page", "ink", "muted", "faint", "panel"].map((name) =>
      style.getPropertyValue(`--${name}`).trim());
    const tagged = { ink, muted, faint, edge: page };
    for (const model of root.references()) {
      if (model.type === "Figure") {
        model.border_fill_color = name === "slice" ? panel : page;
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
      const { entries } = figure.sources[name];
      const fit = entries.filter(([key]) => /^(t|y\d+|x|left|right)$/.test(key)).map(([key, values]) => [`fit_${key}`, values]);
      copy.attributes.data = { type: "map", entries: [...entries, ...fit] };
    }
    if (name && figure.ranges[name]) Object.assign(copy.attributes, figure.ranges[name]);
    if (name === "slice-label") copy.attributes.text = sliceLabel(); // there is no room for one that comes later
    return copy;
  }

  async function embed(name, figure) {
    if (documents.has(name)) return;
    documents.set(name, null);
    const views = await Bokeh.embed.embed_item(fill(payload.templates[figure.template], figure), name);
    const root = [...views.roots][0].model;
    paint(root, name);
    documents.set(name, root.document);
    document.getElementById(name).closest(".run")?.querySelectorAll("[data-channel]").forEach(switchChannel);
  }

  function repaint() {
    for (const [name, doc] of documents) if (doc) doc.roots().forEach((root) => paint(root, name));
  }
  dark.addEventListener("change", repaint);

  // --- runs ----------------------------------------------------------------------------------------------------------

  async function show(choice) {
    for (const element of document.querySelectorAll(".run")) {
      element.classList.toggle("shown", choice === "all" || element.dataset.run === choice);
    }
    const chosen = choice === "all" ? Object.keys(payload.runs) : [choice];
    document.querySelectorAll(".slider").forEach((element, k) => {
      element.classList.toggle("shown", chosen.some((run) => sliders[k].runs.includes(Number(run))));
    });
    for (const run of chosen) await embed(`run-${run}`, payload.runs[run]);
    move();
  }

  function switchChannel(box) {
    const doc = documents.get(`run-${box.closest(".run").dataset.run}`);
    if (doc) doc.get_model_by_name(`channel-${box.dataset.channel}`).visible = box.checked;
  }
  for (const box of document.querySelectorAll("[data-channel]")) {
    box.addEventListener("change", () => switchChannel(box));
  }

  // --- sliders -------------------------------------------------------------------------------------------------------

  const ends = (k) => [sliders[k].values[0], sliders[k].values[sliders[k].values.length - 1]];
  const number = (value, digits) => (value !== 0 && (Math.abs(value) < 1e-3 || Math.abs(value) >= 1e7)
    ? value.toExponential(digits - 1) : value.toPrecision(digits));
  const digits = (value, step) => value.toFixed(Math.min(Math.max(1 - Math.floor(Math.log10(Math.abs(step) || 1)), 0), 12));

  function interpolate(k, value) {
    const { values, costs } = sliders[k];
    let i = 1;
    while (i < values.length - 1 && values[i] < value) i += 1;
    if (costs[i] === null || costs[i - 1] === null) return null;
    return costs[i - 1] + (costs[i] - costs[i - 1]) * (value - values[i - 1]) / (values[i] - values[i - 1]);
  }

  function quadratic(change) {
    let cost = payload.cost;
    change.forEach((d, i) => {
      if (d !== 0) cost += known(payload.gradient[i]) * d;
      change.forEach((other, j) => {
        if (d !== 0 && other !== 0) cost += 0.5 * d * known(payload.hessian[i][j]) * other;
      });
    });
    return cost;
  }

  function moveCurves(run, doc) {
    const by = new Map(sliders.map((slider, k) => [slider.place, moved[k]]));
    const shift = (place) => by.get(place) || 0;
    function change(key, edit) {
      const source = doc.get_model_by_name(key);
      const data = { ...source.data };
      edit(data);
      source.data = data;
    }
    change("modes", (data) => {
      data.left = Float64Array.from(data.fit_left, (left, i) => left + shift(data.left_place[i]));
      data.right = Float64Array.from(data.fit_right, (right, i) => right + shift(data.right_place[i]));
    });
    change("transitions", (data) => { data.x = Float64Array.from(data.fit_x, (x, i) => x + shift(data.place[i])); });
    for (const name of Object.keys(run.sources).filter((own) => /^(curve|samples)-/.test(own))) {
      change(name, (data) => {
        for (const key of Object.keys(data)) if (/^fit_y/.test(key)) data[key.slice(4)] = Float64Array.from(data[key]);
        for (const [key, slope] of Object.entries(data)) {
          const [, place, k] = key.match(/^d(\d+)_(\d+)$/) || []; // a derivative of channel k
          const d = place === undefined ? 0 : shift(Number(place));
          if (d !== 0) data[`y${k}`].forEach((_, i, values) => { values[i] += slope[i] * d; });
        }
      });
    }
    const still = moved.some((d) => d !== 0);
    for (const model of doc.roots().flatMap((root) => [...root.references()])) {
      if (model.name === "still") model.visible = still;
    }
  }

  // What is in the figure of J: columns by source.
  function sliceColumns() {
    const { values, costs, theta } = sliders[last];
    const change = (value) => sliders.map((_, k) => (k === last ? value - theta : 0));
    const rise = (cost) => known(cost) - payload.cost;
    return {
      slice: { x: values, exact: costs.map(rise), quadratic: values.map((value) => rise(quadratic(change(value)))) },
      mark: { x: [theta + moved[last]], y: [rise(interpolate(last, theta + moved[last]))] },
    };
  }

  function sliceLabel() {
    const { name, unit, clock } = sliders[last];
    const shown = clock ? clock.named : unit;
    return shown ? `${name} (${shown})` : name;
  }

  // Labels of the axis of J: dates where the unknown that was moved last is one.
  window.switchfitSlice = {
    label(tick, ticks) {
      const { clock } = sliders[last];
      return clock ? switchfitDates.label(tick, ticks, clock.start, clock.length, clock.zone) : `${Number(tick.toPrecision(6))}`;
    },
  };

  function sliceSources() {
    return Object.fromEntries(Object.entries(sliceColumns()).map(([name, columns]) =>
      [name, { type: "map", entries: Object.entries(columns) }]));
  }

  function drawSlice() {
    const doc = documents.get("slice");
    if (!doc) return;
    for (const [name, columns] of Object.entries(sliceColumns())) doc.get_model_by_name(name).data = columns;
    doc.get_model_by_name("slice-label").text = sliceLabel();
  }

  function move() {
    if (!sliders.length) return;
    sliders.forEach((slider, k) => {
      const [low, high] = ends(k);
      const step = (high - low) / 400;
      const output = document.querySelector(`[data-slider="${k}"] output`);
      const change = moved[k] ? ` (${moved[k] > 0 ? "+" : "−"}${digits(Math.abs(moved[k]), step)})` : "";
      const value = slider.theta + moved[k];
      const { start, length, zone } = slider.clock || {};
      output.textContent = slider.clock
        ? switchfitDates.show(value, step, start, length, zone) + change.replace(")", ` ${slider.unit})`)
        : `${digits(value, step)} ${slider.unit}`.trim() + change;
    });
    const away = moved.flatMap((d, k) => (d === 0 ? [] : [k]));
    const one = away.length === 1 ? interpolate(away[0], sliders[away[0]].theta + moved[away[0]]) : null;
    const cost = away.length === 0 ? payload.cost : one === null ? quadratic(moved) : one;
    const how = away.length === 0 ? "at the estimate" : one === null ? "by the quadratic approximation" : "evaluated";
    const rise = away.length ? `, ${number(cost - payload.cost, 3)} above the estimate's` : "";
    document.getElementById("cost").textContent = Number.isNaN(cost) ? "J is not known there" : `J = ${number(cost, 8)}${rise} (${how})`;
    payload.runs.forEach((run, k) => { const doc = documents.get(`run-${k}`); if (doc) moveCurves(run, doc); });
    drawSlice();
  }

  function place(k) {
    const [low, high] = ends(k);
    document.getElementById(`slider-${k}`).value = Math.round(400 * (sliders[k].theta + moved[k] - low) / (high - low));
  }

  sliders.forEach((slider, k) => {
    place(k);
    document.getElementById(`slider-${k}`).addEventListener("input", (event) => {
      const [low, high] = ends(k);
      const value = low + (high - low) * Number(event.target.value) / 400;
      moved[k] = Math.abs(value - slider.theta) <= 0.5 * (high - low) / 400 ? 0 : value - slider.theta;
      last = k;
      move();
    });
  });
  const reset = document.getElementById("reset");
  if (reset) reset.addEventListener("click", () => { moved.fill(0); sliders.forEach((_, k) => place(k)); move(); });

  // --- start ---------------------------------------------------------------------------------------------------------

  window.addEventListener("beforeprint", () => {
    for (const details of document.querySelectorAll("details")) details.open = true;
  });
  const chooser = document.getElementById("run");
  if (chooser) chooser.addEventListener("change", () => show(chooser.value));
  (async () => {
    await show("0");
    if (sliders.length) await embed("slice", { template: "slice", sources: sliceSources(), ranges: {} });
    move();
    document.documentElement.dataset.ready = "true";
  })();
})();
