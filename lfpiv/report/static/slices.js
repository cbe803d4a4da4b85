"use strict";
// Slices of a vector field on a canvas, moved by a slider.

class SliceView {
  constructor(fields, colours) {
    this.fields = fields;
    this.colours = colours;
    this.probe = null;
    this.part = Object.fromEntries(
      ["field", "colour", "axis", "slider", "place", "canvas", "reading"].map((name) => [
        name, document.getElementById(`slice-${name}`),
      ]),
    );
    fill(this.part.field, fields.map((field, number) => [number, field.label]));
    this.part.field.addEventListener("change", () => this.takeField());
    this.part.axis.addEventListener("change", () => this.takeAxis());
    this.part.colour.addEventListener("change", () => this.draw());
    this.part.slider.addEventListener("input", () => this.draw());
    const canvas = this.part.canvas;
    canvas.addEventListener("pointermove", (event) => this.point(event));
    canvas.addEventListener("pointerleave", () => this.setProbe(null));
    canvas.addEventListener("keydown", (event) => this.moveProbe(event));
    canvas.addEventListener("blur", () => this.setProbe(null));
    new ResizeObserver(() => this.draw()).observe(canvas.parentElement);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.takeField();
  }

  get field() { return this.fields[Number(this.part.field.value)]; }
  get normal() { return this.part.axis.value; }
  get place() { return Number(this.part.slider.value); }

  takeField() {
    const names = this.field.quantities();
    const first = this.part.colour.options.length === 0;
    fill(this.part.colour, names.map((name) => [name, this.field.title(name)]));
    if (first) this.part.colour.value = "w";
    this.takeAxis();
    this.writeTable();
  }

  takeAxis() {
    const slider = this.part.slider;
    const last = this.field.axis[this.normal].length - 1;
    if (this.shownAxis !== this.normal || Number(slider.max) !== last) {
      slider.max = last;
      slider.value = Math.floor((last + 1) / 2);
      this.shownAxis = this.normal;
    }
    this.probe = null;
    this.draw();
  }

  /** Where things go on the canvas, in CSS pixels. */
  layout() {
    const [across, up] = inSlice(this.normal);
    const edges = [across, up].map((name) => {
      const axis = this.field.axis[name];
      const half = this.field.spacing(name) / 2;
      return [axis[0] - half, axis[axis.length - 1] + half];
    });
    const span = edges.map(([low, high]) => high - low);
    const whole = this.part.canvas.parentElement.clientWidth;
    const margin = { left: 54, right: 14, top: 26, bottom: 92 };
    const most = Math.max(0.62 * window.innerHeight, 220);
    const scale = Math.min((whole - margin.left - margin.right) / span[0], most / span[1]);
    const [width, height] = span.map((value) => value * scale);
    const left = margin.left + Math.max((whole - margin.left - margin.right - width) / 2, 0);
    const total = height + margin.top + margin.bottom;
    return { across, up, edges, scale, whole, width, height, left, top: margin.top, total };
  }

  draw() {
    const { canvas } = this.part;
    const at = this.layout();
    if (!(at.whole > 0)) return;
    const dense = window.devicePixelRatio || 1;
    canvas.width = Math.round(at.whole * dense);
    canvas.height = Math.round(at.total * dense);
    canvas.style.height = `${at.total}px`;
    const pen = canvas.getContext("2d");
    pen.scale(dense, dense);
    this.ink = getComputedStyle(canvas).color;
    pen.font = "12px system-ui, sans-serif";
    this.drawCells(pen, at);
    if (this.field.isVector) this.drawArrows(pen, at);
    this.drawFrame(pen, at);
    this.drawBar(pen, at);
    if (this.probe) this.drawProbe(pen, at);
    this.at = at;
    this.say();
  }

  /** Colour map of the chosen quantity: its stops and what a value's share of it is. */
  scale() {
    const name = this.part.colour.value;
    const limit = this.field.top(name, 0.99) || 1;
    const signed = this.field.isSigned(name);
    return {
      stops: signed ? this.colours.signed : this.colours.positive,
      low: signed ? -limit : 0,
      high: limit,
      share: (value) => (signed ? (value / limit + 1) / 2 : value / limit),
    };
  }

  drawCells(pen, at) {
    const values = this.field.values(this.part.colour.value);
    const scale = this.scale();
    const cell = [at.across, at.up].map((name) => this.field.spacing(name) * at.scale);
    this.field.forSlice(this.normal, this.place, (index, column, row) => {
      if (!Number.isFinite(values[index])) return;
      pen.fillStyle = colourAt(scale.stops, scale.share(values[index]));
      const x = at.left + column * cell[0];
      const y = at.top + at.height - (row + 1) * cell[1];
      pen.fillRect(Math.floor(x), Math.floor(y), Math.ceil(cell[0]) + 1, Math.ceil(cell[1]) + 1);
    });
    pen.clearRect(at.left + at.width, 0, at.whole, at.total); // what cells reach beyond the frame
    pen.clearRect(0, at.top + at.height, at.whole, at.total);
  }

  drawArrows(pen, at) {
    const cell = [at.across, at.up].map((name) => this.field.spacing(name) * at.scale);
    const step = Math.max(Math.ceil(13 / Math.min(...cell)), 1);
    const names = [at.across, at.up].map((axis) => COMPONENT[axis]);
    const longest = Math.max(...names.map((name) => this.field.top(name, 0.99)));
    if (!(longest > 0)) return;
    const scale = (1.3 * step * Math.min(...cell)) / longest;
    const [u, v] = names.map((name) => this.field.values(name));
    const head = 0.35 * step * Math.min(...cell);
    this.field.forSlice(this.normal, this.place, (index, column, row) => {
      const offset = Math.floor(step / 2);
      if (column % step !== offset || row % step !== offset) return;
      const from = this.centre(at, column, row);
      arrow(pen, from, [u[index] * scale, -v[index] * scale], head, this.field.isGood(index) ? "#101418" : "#8b9198");
    });
    const speed = roundBelow(longest);
    const from = [at.left, at.top - 12];
    arrow(pen, from, [speed * scale, 0], head, this.ink);
    pen.fillStyle = this.ink;
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    pen.fillText(`${short(speed)} m/s (${names.join(", ")})`, at.left + speed * scale + 8, at.top - 12);
  }

  centre(at, column, row) {
    const cell = [at.across, at.up].map((name) => this.field.spacing(name) * at.scale);
    return [at.left + (column + 0.5) * cell[0], at.top + at.height - (row + 0.5) * cell[1]];
  }

  drawFrame(pen, at) {
    pen.strokeStyle = this.ink;
    pen.fillStyle = this.ink;
    pen.lineWidth = 1;
    pen.strokeRect(at.left, at.top, at.width, at.height);
    const axisTicks = (axis, length) => ticks(...at.edges[axis], Math.max(Math.min(Math.floor(length / 55), 8), 2));
    pen.textAlign = "center";
    pen.textBaseline = "top";
    for (const value of axisTicks(0, at.width)) {
      const x = at.left + (value - at.edges[0][0]) * at.scale;
      line(pen, [x, at.top + at.height], [x, at.top + at.height + 4]);
      pen.fillText(short(value, 6), x, at.top + at.height + 6);
    }
    pen.fillText(`${at.across} [mm]`, at.left + at.width / 2, at.top + at.height + 22);
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (const value of axisTicks(1, at.height)) {
      const y = at.top + at.height - (value - at.edges[1][0]) * at.scale;
      line(pen, [at.left - 4, y], [at.left, y]);
      pen.fillText(short(value, 6), at.left - 6, y);
    }
    pen.save();
    pen.translate(at.left - 44, at.top + at.height / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText(`${at.up} [mm]`, 0, 0);
    pen.restore();
  }

  drawBar(pen, at) {
    const scale = this.scale();
    const width = Math.min(at.whole - 40, 320);
    const left = Math.min(Math.max(at.left + at.width / 2 - width / 2, 20), at.whole - width - 20);
    const top = at.top + at.height + 44;
    const steps = 160;
    for (let k = 0; k < steps; k += 1) {
      pen.fillStyle = colourAt(scale.stops, (k + 0.5) / steps);
      pen.fillRect(left + (k * width) / steps, top, width / steps + 0.6, 10);
    }
    pen.strokeStyle = this.ink;
    pen.strokeRect(left, top, width, 10);
    pen.fillStyle = this.ink;
    pen.textAlign = "center";
    pen.textBaseline = "top";
    for (const value of ticks(scale.low, scale.high, 4)) {
      const x = left + ((value - scale.low) / (scale.high - scale.low)) * width;
      line(pen, [x, top + 10], [x, top + 13]);
      pen.fillText(short(value, 6), x, top + 14);
    }
    pen.fillText(this.field.title(this.part.colour.value), left + width / 2, top + 30);
  }

  drawProbe(pen, at) {
    const cell = [at.across, at.up].map((name) => this.field.spacing(name) * at.scale);
    const [x, y] = this.centre(at, ...this.probe);
    pen.lineWidth = 3;
    pen.strokeStyle = "#ffffff";
    pen.strokeRect(x - cell[0] / 2, y - cell[1] / 2, cell[0], cell[1]);
    pen.lineWidth = 1.5;
    pen.strokeStyle = "#000000";
    pen.strokeRect(x - cell[0] / 2, y - cell[1] / 2, cell[0], cell[1]);
  }

  point(event) {
    const box = this.part.canvas.getBoundingClientRect();
    const { at, field } = this;
    const column = Math.floor((event.clientX - box.left - at.left) / (field.spacing(at.across) * at.scale));
    const row = Math.floor((at.top + at.height - event.clientY + box.top) / (field.spacing(at.up) * at.scale));
    const inside = column >= 0 && row >= 0 && column < field.axis[at.across].length && row < field.axis[at.up].length;
    this.setProbe(inside ? [column, row] : null);
  }

  moveProbe(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step) return;
    event.preventDefault();
    const [across, up] = inSlice(this.normal);
    const count = [this.field.axis[across].length, this.field.axis[up].length];
    const from = this.probe || count.map((n) => Math.floor(n / 2));
    const moved = this.probe ? from.map((value, k) => Math.min(Math.max(value + step[k], 0), count[k] - 1)) : from;
    this.setProbe(moved);
  }

  setProbe(probe) {
    if (String(probe) === String(this.probe)) return;
    this.probe = probe;
    this.draw();
  }

  /** Put the slice, or the vector pointed at, into words. */
  say() {
    const { field, normal } = this;
    const where = `${normal} = ${fixed(field.axis[normal][this.place], 3)} mm`;
    this.part.place.textContent = where;
    this.part.slider.setAttribute("aria-valuetext", where);
    this.part.canvas.setAttribute("aria-label", `${field.label}, slice at ${where}`);
    this.part.reading.textContent = this.probe ? this.vectorInWords() : this.sliceInWords(where);
  }

  sliceInWords(where) {
    const sums = this.field.summary(this.normal, this.place);
    const mark = this.field.isVector ? "" : "′";
    const parts = ["u", "v", "w"].map((name) => `${name}${mark} ${short(sums[name])}`).join(", ");
    return `${where}: ${sums.good} of ${sums.count} vectors valid; mean ${parts} m/s; rms ${short(sums.rms)}, `
      + `largest ${short(sums.largest)} m/s.`;
  }

  vectorInWords() {
    const { field } = this;
    const [across, up] = inSlice(this.normal);
    const at = { [this.normal]: this.place, [across]: this.probe[0], [up]: this.probe[1] };
    const index = field.index(at.z, at.y, at.x);
    const where = ["x", "y", "z"].map((name) => fixed(field.axis[name][at[name]], 3)).join(", ");
    const values = field.quantities().map((name) => {
      const [label, unit] = field.title(name).split(" [");
      return `${label} ${short(field.values(name)[index])} ${unit.slice(0, -1)}`;
    });
    const doubt = field.isVector ? "replaced after validation" : "valid in too few pairs";
    return `(x, y, z) = (${where}) mm: ${values.join(", ")}; ${field.valid[index] ? "valid" : doubt}.`;
  }

  /** The table by depth of the chosen field. */
  writeTable() {
    document.getElementById("depth-field").textContent = this.field.label;
    const rows = this.field.axis.z.map((depth, k) => {
      const sums = this.field.summary("z", k);
      const row = document.createElement("tr");
      const cells = [
        String(sums.count), `${((100 * sums.good) / sums.count).toFixed(1)} %`,
        ...["u", "v", "w", "rms", "largest"].map((name) => short(sums[name])),
      ];
      const head = document.createElement("th");
      head.scope = "row";
      head.textContent = fixed(depth, 3);
      row.append(head, ...cells.map((text) => Object.assign(document.createElement("td"), { textContent: text })));
      return row;
    });
    document.querySelector("#depth-table tbody").replaceChildren(...rows);
  }
}

function arrow(pen, from, step, head, colour) {
  const length = Math.hypot(...step);
  if (!(length > 0.5)) return;
  const along = step.map((value) => value / length);
  const tip = [from[0] + step[0], from[1] + step[1]];
  const barb = Math.min(head, length / 2.5, 9);
  pen.strokeStyle = colour;
  pen.lineWidth = 1.2;
  line(pen, from, tip);
  for (const side of [0.45, -0.45]) {
    line(pen, tip, [tip[0] - barb * (along[0] + side * along[1]), tip[1] - barb * (along[1] - side * along[0])]);
  }
}

function line(pen, from, to) {
  pen.beginPath();
  pen.moveTo(...from);
  pen.lineTo(...to);
  pen.stroke();
}

/** Largest of 1, 2, 5, 10, ... times a power of ten up to a value. */
function roundBelow(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find((step) => step * power <= value * (1 + 1e-9)) * power;
}

/** Round values between two ends, about so many. */
function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= rough * (1 - 1e-9)) * power;
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    found.push(Number((k * step).toPrecision(12)));
  }
  return found;
}
