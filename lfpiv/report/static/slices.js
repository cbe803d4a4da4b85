"use strict";
// Draw slices of a vector field on a canvas; a slider selects the layer.

class SliceView {
  constructor(fields, colours) {
    this.fields = fields;
    this.colours = colours;
    this.selected = null;
    this.elements = Object.fromEntries(
      ["field", "colour", "axis", "slider", "place", "canvas", "reading"].map((name) => [
        name, document.getElementById(`slice-${name}`),
      ]),
    );
    fillOptions(this.elements.field, fields.map((field, number) => [number, field.label]));
    this.elements.field.addEventListener("change", () => this.selectField());
    this.elements.axis.addEventListener("change", () => this.selectAxis());
    this.elements.colour.addEventListener("change", () => this.draw());
    this.elements.slider.addEventListener("input", () => this.draw());
    const canvas = this.elements.canvas;
    canvas.addEventListener("pointermove", (event) => this.selectPointed(event));
    canvas.addEventListener("pointerleave", () => this.select(null));
    canvas.addEventListener("keydown", (event) => this.moveSelection(event));
    canvas.addEventListener("blur", () => this.select(null));
    new ResizeObserver(() => this.draw()).observe(canvas.parentElement);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.selectField();
  }

  get field() { return this.fields[Number(this.elements.field.value)]; }
  get normal() { return this.elements.axis.value; }
  get layer() { return Number(this.elements.slider.value); }

  selectField() {
    const names = this.field.quantities();
    const first = this.elements.colour.options.length === 0;
    fillOptions(this.elements.colour, names.map((name) => [name, this.field.title(name)]));
    if (first) this.elements.colour.value = "w";
    this.selectAxis();
    this.writeTable();
  }

  selectAxis() {
    const slider = this.elements.slider;
    const last = this.field.axis[this.normal].length - 1;
    if (this.shownAxis !== this.normal || Number(slider.max) !== last) {
      slider.max = last;
      slider.value = Math.floor((last + 1) / 2);
      this.shownAxis = this.normal;
    }
    this.selected = null;
    this.draw();
  }

  /** Return positions and sizes on the canvas [CSS pixel]. */
  layout() {
    const [across, up] = sliceAxes(this.normal);
    const edges = [across, up].map((name) => {
      const axis = this.field.axis[name];
      const half = this.field.spacing(name) / 2;
      return [axis[0] - half, axis[axis.length - 1] + half];
    });
    const span = edges.map(([low, high]) => high - low);
    const outerWidth = this.elements.canvas.parentElement.clientWidth;
    const margin = { left: 54, right: 14, top: 26, bottom: 92 };
    const most = Math.max(0.62 * window.innerHeight, 220);
    const scale = Math.min((outerWidth - margin.left - margin.right) / span[0], most / span[1]);
    const [width, height] = span.map((value) => value * scale);
    const left = margin.left + Math.max((outerWidth - margin.left - margin.right - width) / 2, 0);
    const total = height + margin.top + margin.bottom;
    return { across, up, edges, scale, outerWidth, width, height, left, top: margin.top, total };
  }

  draw() {
    const { canvas } = this.elements;
    const box = this.layout();
    if (!(box.outerWidth > 0)) return;
    const pixelRatio = window.devicePixelRatio || 1;
    canvas.width = Math.round(box.outerWidth * pixelRatio);
    canvas.height = Math.round(box.total * pixelRatio);
    canvas.style.height = `${box.total}px`;
    const context = canvas.getContext("2d");
    context.scale(pixelRatio, pixelRatio);
    this.ink = getComputedStyle(canvas).color;
    context.font = "12px system-ui, sans-serif";
    this.drawCells(context, box);
    if (this.field.isVector) this.drawArrows(context, box);
    this.drawFrame(context, box);
    this.drawBar(context, box);
    if (this.selected) this.drawSelected(context, box);
    this.box = box;
    this.describe();
  }

  /** Return the colour map of the chosen quantity: its stops and ends, and a value's share of it. */
  scale() {
    const name = this.elements.colour.value;
    const limit = this.field.magnitudeQuantile(name, 0.99) || 1;
    const signed = this.field.isSigned(name);
    return {
      stops: signed ? this.colours.signed : this.colours.positive,
      low: signed ? -limit : 0,
      high: limit,
      share: (value) => (signed ? (value / limit + 1) / 2 : value / limit),
    };
  }

  drawCells(context, box) {
    const values = this.field.values(this.elements.colour.value);
    const scale = this.scale();
    const cell = [box.across, box.up].map((name) => this.field.spacing(name) * box.scale);
    this.field.forSlice(this.normal, this.layer, (index, column, row) => {
      const x = box.left + column * cell[0];
      const y = box.top + box.height - (row + 1) * cell[1];
      if (this.field.isMasked(index)) hatch(context, [x, y], cell);
      if (!Number.isFinite(values[index])) return;
      context.fillStyle = colourAt(scale.stops, scale.share(values[index]));
      context.fillRect(Math.floor(x), Math.floor(y), Math.ceil(cell[0]) + 1, Math.ceil(cell[1]) + 1);
    });
    context.clearRect(box.left + box.width, 0, box.outerWidth, box.total); // parts of cells beyond the frame
    context.clearRect(0, box.top + box.height, box.outerWidth, box.total);
  }

  drawArrows(context, box) {
    const cell = [box.across, box.up].map((name) => this.field.spacing(name) * box.scale);
    const step = Math.max(Math.ceil(13 / Math.min(...cell)), 1);
    const names = [box.across, box.up].map((axis) => COMPONENT[axis]);
    const longest = Math.max(...names.map((name) => this.field.magnitudeQuantile(name, 0.99)));
    if (!(longest > 0)) return;
    const scale = (1.3 * step * Math.min(...cell)) / longest;
    const [u, v] = names.map((name) => this.field.values(name));
    const head = 0.35 * step * Math.min(...cell);
    this.field.forSlice(this.normal, this.layer, (index, column, row) => {
      const offset = Math.floor(step / 2);
      if (column % step !== offset || row % step !== offset) return;
      const from = this.centre(box, column, row);
      const colour = this.field.isValid(index) ? "#101418" : "#8b9198";
      arrow(context, from, [u[index] * scale, -v[index] * scale], head, colour);
    });
    const speed = roundBelow(longest);
    const from = [box.left, box.top - 12];
    arrow(context, from, [speed * scale, 0], head, this.ink);
    context.fillStyle = this.ink;
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.fillText(`${significant(speed)} m/s (${names.join(", ")})`, box.left + speed * scale + 8, box.top - 12);
  }

  centre(box, column, row) {
    const cell = [box.across, box.up].map((name) => this.field.spacing(name) * box.scale);
    return [box.left + (column + 0.5) * cell[0], box.top + box.height - (row + 0.5) * cell[1]];
  }

  drawFrame(context, box) {
    context.strokeStyle = this.ink;
    context.fillStyle = this.ink;
    context.lineWidth = 1;
    context.strokeRect(box.left, box.top, box.width, box.height);
    const axisTicks = (axis, length) => ticks(...box.edges[axis], Math.max(Math.min(Math.floor(length / 55), 8), 2));
    context.textAlign = "center";
    context.textBaseline = "top";
    for (const value of axisTicks(0, box.width)) {
      const x = box.left + (value - box.edges[0][0]) * box.scale;
      line(context, [x, box.top + box.height], [x, box.top + box.height + 4]);
      context.fillText(significant(value, 6), x, box.top + box.height + 6);
    }
    context.fillText(`${box.across} [mm]`, box.left + box.width / 2, box.top + box.height + 22);
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const value of axisTicks(1, box.height)) {
      const y = box.top + box.height - (value - box.edges[1][0]) * box.scale;
      line(context, [box.left - 4, y], [box.left, y]);
      context.fillText(significant(value, 6), box.left - 6, y);
    }
    context.save();
    context.translate(box.left - 44, box.top + box.height / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.fillText(`${box.up} [mm]`, 0, 0);
    context.restore();
  }

  drawBar(context, box) {
    const scale = this.scale();
    const width = Math.min(box.outerWidth - 40, 320);
    const left = Math.min(Math.max(box.left + box.width / 2 - width / 2, 20), box.outerWidth - width - 20);
    const top = box.top + box.height + 44;
    const steps = 160;
    for (let k = 0; k < steps; k += 1) {
      context.fillStyle = colourAt(scale.stops, (k + 0.5) / steps);
      context.fillRect(left + (k * width) / steps, top, width / steps + 0.6, 10);
    }
    context.strokeStyle = this.ink;
    context.strokeRect(left, top, width, 10);
    context.fillStyle = this.ink;
    context.textAlign = "center";
    context.textBaseline = "top";
    for (const value of ticks(scale.low, scale.high, 4)) {
      const x = left + ((value - scale.low) / (scale.high - scale.low)) * width;
      line(context, [x, top + 10], [x, top + 13]);
      context.fillText(significant(value, 6), x, top + 14);
    }
    context.fillText(this.field.title(this.elements.colour.value), left + width / 2, top + 30);
  }

  drawSelected(context, box) {
    const cell = [box.across, box.up].map((name) => this.field.spacing(name) * box.scale);
    const [x, y] = this.centre(box, ...this.selected);
    context.lineWidth = 3;
    context.strokeStyle = "#ffffff";
    context.strokeRect(x - cell[0] / 2, y - cell[1] / 2, cell[0], cell[1]);
    context.lineWidth = 1.5;
    context.strokeStyle = "#000000";
    context.strokeRect(x - cell[0] / 2, y - cell[1] / 2, cell[0], cell[1]);
  }

  selectPointed(event) {
    const canvas = this.elements.canvas.getBoundingClientRect();
    const { box, field } = this;
    const column = Math.floor((event.clientX - canvas.left - box.left) / (field.spacing(box.across) * box.scale));
    const row = Math.floor((box.top + box.height - event.clientY + canvas.top) / (field.spacing(box.up) * box.scale));
    const inside = column >= 0 && row >= 0 && column < field.axis[box.across].length && row < field.axis[box.up].length;
    this.select(inside ? [column, row] : null);
  }

  moveSelection(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step) return;
    event.preventDefault();
    const [across, up] = sliceAxes(this.normal);
    const count = [this.field.axis[across].length, this.field.axis[up].length];
    const from = this.selected || count.map((n) => Math.floor(n / 2));
    const moved = this.selected ? from.map((value, k) => Math.min(Math.max(value + step[k], 0), count[k] - 1)) : from;
    this.select(moved);
  }

  /** Select the vector at [column, row], or none. */
  select(vector) {
    if (String(vector) === String(this.selected)) return;
    this.selected = vector;
    this.draw();
  }

  /** Describe the slice, or the selected vector, in words. */
  describe() {
    const { field, normal } = this;
    const where = `${normal} = ${fixed(field.axis[normal][this.layer], 3)} mm`;
    this.elements.place.textContent = where;
    this.elements.slider.setAttribute("aria-valuetext", where);
    this.elements.canvas.setAttribute("aria-label", `${field.label}, slice at ${where}`);
    this.elements.reading.textContent = this.selected ? this.describeVector() : this.describeSlice(where);
  }

  describeSlice(where) {
    const statistics = this.field.sliceStatistics(this.normal, this.layer);
    const mark = this.field.isVector ? "" : "′";
    const parts = ["u", "v", "w"].map((name) => `${name}${mark} ${significant(statistics[name])}`).join(", ");
    return `${where}: ${statistics.good} of ${statistics.count} vectors valid; mean ${parts} m/s; `
      + `rms ${significant(statistics.rms)}, largest ${significant(statistics.largest)} m/s.`;
  }

  describeVector() {
    const { field } = this;
    const [across, up] = sliceAxes(this.normal);
    const position = { [this.normal]: this.layer, [across]: this.selected[0], [up]: this.selected[1] };
    const index = field.index(position.z, position.y, position.x);
    const where = ["x", "y", "z"].map((name) => fixed(field.axis[name][position[name]], 3)).join(", ");
    const values = field.quantities().map((name) => {
      const [label, unit] = field.title(name).split(" [");
      return `${label} ${significant(field.values(name)[index])} ${unit.slice(0, -1)}`;
    });
    if (field.isMasked(index)) return `(x, y, z) = (${where}) mm: masked, too little fluid.`;
    const replaced = field.isVector ? "replaced after validation" : "valid in too few fields";
    return `(x, y, z) = (${where}) mm: ${values.join(", ")}; ${field.valid[index] ? "valid" : replaced}.`;
  }

  /** Write the table by depth of the chosen field. */
  writeTable() {
    document.getElementById("depth-field").textContent = this.field.label;
    const rows = this.field.axis.z.map((depth, k) => {
      const statistics = this.field.sliceStatistics("z", k);
      const row = document.createElement("tr");
      const cells = [
        String(statistics.count), statistics.count ? `${((100 * statistics.good) / statistics.count).toFixed(1)} %` : "–",
        ...["u", "v", "w", "rms", "largest"].map((name) => significant(statistics[name])),
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

/** Hatch a masked cell. */
function hatch(context, [x, y], [width, height]) {
  context.fillStyle = "#d5d8db";
  context.fillRect(x, y, width, height);
  context.strokeStyle = "#9aa0a6";
  context.lineWidth = 1;
  line(context, [x, y + height], [x + width, y]);
  line(context, [x, y + height / 2], [x + width / 2, y]);
  line(context, [x + width / 2, y + height], [x + width, y + height / 2]);
}

/** Draw an arrow with its tail at `from`; arrows shorter than half a pixel are left out. */
function arrow(context, from, step, head, colour) {
  const length = Math.hypot(...step);
  if (!(length > 0.5)) return;
  const along = step.map((value) => value / length);
  const tip = [from[0] + step[0], from[1] + step[1]];
  const barb = Math.min(head, length / 2.5, 9);
  context.strokeStyle = colour;
  context.lineWidth = 1.2;
  line(context, from, tip);
  for (const side of [0.45, -0.45]) {
    line(context, tip, [tip[0] - barb * (along[0] + side * along[1]), tip[1] - barb * (along[1] - side * along[0])]);
  }
}

function line(context, from, to) {
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}

/** Return the largest 1, 2 or 5 times a power of ten that does not exceed a value. */
function roundBelow(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find((step) => step * power <= value * (1 + 1e-9)) * power;
}

/** Return about `count` round values between two ends. */
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
