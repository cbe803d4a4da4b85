"use strict";
// Draw slices of a vector field on a canvas; a slider selects the layer, a click the line of the profiles.

/** Smallest distance of arrows, and of streamlines [CSS pixel]. */
const ARROWS_APART = 20, STREAMLINES_APART = 24;
const MARGIN = { left: 58, right: 16, top: 30, bottom: 92 };

class SliceView {
  constructor(fields, colours, start, profile) {
    this.fields = fields;
    this.colours = colours;
    this.profile = profile;
    this.selected = null;
    /** Indices of the vector through which the slice and the line of the profiles go. */
    this.place = { ...start.place };
    this.elements = Object.fromEntries(
      ["field", "colour", "axis", "overlay", "smooth", "along", "slider", "place", "canvas", "reading"].map((name) => [
        name, document.getElementById(`slice-${name}`),
      ]),
    );
    const { field, colour, axis, overlay, smooth, along, slider, canvas } = this.elements;
    fillOptions(field, fields.map((entry, number) => [number, entry.label]));
    field.addEventListener("change", () => this.selectField());
    axis.addEventListener("change", () => this.selectAxis());
    for (const choice of [colour, overlay, smooth, along]) choice.addEventListener("change", () => this.draw());
    slider.addEventListener("input", () => this.selectLayer());
    canvas.addEventListener("pointermove", (event) => this.select(this.pointed(event)));
    canvas.addEventListener("click", (event) => this.pin(this.pointed(event)));
    canvas.addEventListener("pointerleave", () => this.select(null));
    canvas.addEventListener("keydown", (event) => this.moveSelection(event));
    canvas.addEventListener("blur", () => this.select(null));
    new ResizeObserver(() => this.draw()).observe(canvas.parentElement);
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    axis.value = start.normal;
    this.selectField(start.quantity, start.along);
  }

  get field() { return this.fields[Number(this.elements.field.value)]; }
  get normal() { return this.elements.axis.value; }
  get layer() { return Number(this.elements.slider.value); }

  selectField(colour = null, along = null) {
    const names = this.field.quantities();
    fillOptions(this.elements.colour, names.map((name) => [name, this.field.title(name)]));
    if (colour) this.elements.colour.value = colour;
    this.selectAxis(along);
    this.writeTable();
  }

  selectAxis(along = null) {
    const { slider } = this.elements;
    for (const name of AXES) this.place[name] = Math.min(this.place[name], this.field.axis[name].length - 1);
    slider.max = this.field.axis[this.normal].length - 1;
    slider.value = this.place[this.normal];
    fillOptions(this.elements.along, sliceAxes(this.normal).map((name) => [name, name]));
    if (along) this.elements.along.value = along;
    this.selected = null;
    this.draw();
  }

  selectLayer() {
    this.place[this.normal] = this.layer;
    this.draw();
  }

  /** Put the line of the profiles through a vector. */
  pin(vector) {
    if (!vector) return;
    const [across, up] = sliceAxes(this.normal);
    [this.place[across], this.place[up]] = vector;
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
    const room = outerWidth - MARGIN.left - MARGIN.right;
    const most = Math.max(0.6 * window.innerHeight, 220);
    const scale = Math.min(room / span[0], most / span[1]);
    const [width, height] = span.map((value) => value * scale);
    const cell = [across, up].map((name) => this.field.spacing(name) * scale);
    const left = MARGIN.left + Math.max((room - width) / 2, 0);
    const total = height + MARGIN.top + MARGIN.bottom;
    const counts = [across, up].map((name) => this.field.axis[name].length);
    return { across, up, edges, cell, counts, outerWidth, width, height, left, top: MARGIN.top, total };
  }

  draw() {
    const { canvas, colour, overlay } = this.elements;
    const box = this.layout();
    if (!(box.outerWidth > 0)) return;
    const context = prepare(canvas, box.outerWidth, box.total);
    this.ink = getComputedStyle(canvas).color;
    context.save();
    context.beginPath();
    context.rect(box.left, box.top, box.width, box.height);
    context.clip();
    this.drawColours(context, box);
    this.drawLine(context, box);
    if (this.field.isVector && overlay.value === "streamlines") this.drawStreamlines(context, box);
    const arrows = this.field.isVector && overlay.value === "arrows" ? this.arrowScale(box) : null;
    if (arrows) this.drawArrows(context, box, arrows);
    if (this.selected) this.drawSelected(context, box);
    context.restore();
    if (arrows) this.drawReference(context, box, arrows);
    drawAxes(context, box, box.edges, [`${box.across} [mm]`, `${box.up} [mm]`], this.ink);
    const width = Math.min(box.outerWidth - 40, 320);
    const left = Math.min(Math.max(box.left + box.width / 2 - width / 2, 20), box.outerWidth - width - 20);
    drawBar(context, [left, box.top + box.height + 44, width], this.scale(), this.field.title(colour.value), this.ink);
    this.box = box;
    this.describe();
    this.profile.draw(this.field, this.place, this.elements.along.value, this.ink);
  }

  /** Return the colour map of the chosen quantity: its stops and ends, and a value's share of it. */
  scale() {
    const name = this.elements.colour.value;
    const limit = this.field.magnitudeQuantile(name, name === "uncertainty" ? 0.95 : 0.99) || 1; // it has a long tail
    const signed = this.field.isSigned(name);
    return {
      stops: signed ? this.colours.signed : this.colours.positive,
      low: signed ? -limit : 0,
      high: limit,
      share: (value) => (signed ? (value / limit + 1) / 2 : value / limit),
    };
  }

  drawColours(context, box) {
    const { colour, smooth } = this.elements;
    const values = this.field.values(colour.value);
    const { share, stops } = this.scale();
    const layer = new Float32Array(box.counts[0] * box.counts[1]);
    this.field.forSlice(this.normal, this.layer, (index, column, row) => {
      layer[row * box.counts[0] + column] = this.field.isMasked(index) ? NaN : values[index];
    });
    paintField(context, layer, box.counts, [box.left, box.top, box.width, box.height], share, stops, smooth.checked);
    this.field.forSlice(this.normal, this.layer, (index, column, row) => {
      const corner = [box.left + column * box.cell[0], box.top + box.height - (row + 1) * box.cell[1]];
      if (this.field.isMasked(index)) hatch(context, corner, box.cell);
    });
  }

  /** Mark the line of the profiles. */
  drawLine(context, box) {
    const [x, y] = this.centre(box, this.place[box.across], this.place[box.up]);
    const path = new Path2D();
    const level = this.elements.along.value === box.across;
    path.moveTo(level ? box.left : x, level ? y : box.top);
    path.lineTo(level ? box.left + box.width : x, level ? y : box.top + box.height);
    context.setLineDash([7, 5]);
    outlined(context, path, ["#0b0f14", "#ffffff"], 1);
    context.setLineDash([]);
  }

  /** Return names, spacing and scale of the arrows; null for a field at rest. Arrows are as long as they are apart. */
  arrowScale(box) {
    const step = Math.max(Math.ceil(ARROWS_APART / Math.min(...box.cell)), 1);
    const names = [box.across, box.up].map((axis) => COMPONENT[axis]);
    const longest = this.field.inPlaneQuantile(names, 0.995);
    const apart = step * Math.min(...box.cell);
    return longest > 0 ? { step, names, longest, apart, scale: Math.min(apart, 60) / longest } : null;
  }

  drawArrows(context, box, { step, names, apart, scale }) {
    const [u, v] = names.map((name) => this.field.values(name));
    this.field.forSlice(this.normal, this.layer, (index, column, row) => {
      const offset = Math.floor((step - 1) / 2);
      if (column % step !== offset || row % step !== offset || this.field.isMasked(index)) return;
      const colours = this.field.isValid(index) ? ARROW.measured : ARROW.replaced;
      arrow(context, this.centre(box, column, row), [u[index] * scale, -v[index] * scale], 0.32 * apart, colours);
    });
  }

  /** Draw an arrow of a round length above the slice. */
  drawReference(context, box, { names, longest, apart, scale }) {
    const speed = roundBelow(longest);
    const length = speed * scale;
    arrow(context, [box.left + length / 2, box.top - 14], [length, 0], 0.32 * apart, [this.ink, "transparent"]);
    context.fillStyle = this.ink;
    context.textAlign = "left";
    context.textBaseline = "middle";
    const unit = QUANTITIES.speed.unit;
    context.fillText(`${significant(speed)} ${unit} (${names.join(", ")})`, box.left + length + 8, box.top - 14);
  }

  drawStreamlines(context, box) {
    const names = [box.across, box.up].map((axis) => COMPONENT[axis]);
    const [u, v] = names.map((name) => this.field.values(name));
    const [columns, rows] = box.counts;
    const layers = [u, v].map((values, axis) => {
      const layer = new Float32Array(columns * rows);
      this.field.forSlice(this.normal, this.layer, (index, column, row) => {
        layer[row * columns + column] = this.field.isMasked(index) ? NaN : values[index] / box.cell[1 - axis];
      });
      return layer;
    });
    const sample = ([x, y]) => {
      if (x < -0.5 || y < -0.5 || x > columns - 0.5 || y > rows - 0.5) return null;
      const velocity = layers.map((layer) => between(layer, columns, rows, x, y));
      return velocity.every(Number.isFinite) ? velocity : null;
    };
    const largest = this.field.inPlaneQuantile(names, 0.995) / Math.max(...box.cell);
    const found = streamlines(sample, box.counts, STREAMLINES_APART / Math.min(...box.cell), largest, 400);
    for (const places of found) {
      const points = places.map(([x, y]) => this.centre(box, x, y));
      const path = new Path2D();
      points.forEach((point, k) => (k ? path.lineTo(...point) : path.moveTo(...point)));
      const middle = Math.max(Math.floor(points.length / 2), 1);
      const [from, tip] = [points[middle - 1], points[middle]];
      const length = Math.hypot(tip[0] - from[0], tip[1] - from[1]);
      const along = [tip[0] - from[0], tip[1] - from[1]].map((value) => value / length);
      for (const side of [0.6, -0.6]) {
        path.moveTo(...tip);
        path.lineTo(tip[0] - 6 * (along[0] + side * along[1]), tip[1] - 6 * (along[1] - side * along[0]));
      }
      outlined(context, path, ARROW.measured, 1.1);
    }
  }

  centre(box, column, row) {
    return [box.left + (column + 0.5) * box.cell[0], box.top + box.height - (row + 0.5) * box.cell[1]];
  }

  drawSelected(context, box) {
    const [x, y] = this.centre(box, ...this.selected);
    for (const [width, colour] of [[3, "#ffffff"], [1.5, "#000000"]]) {
      context.lineWidth = width;
      context.strokeStyle = colour;
      context.strokeRect(x - box.cell[0] / 2, y - box.cell[1] / 2, ...box.cell);
    }
  }

  /** Return the [column, row] of the vector under the pointer, or null. */
  pointed(event) {
    const { box } = this;
    const frame = this.elements.canvas.getBoundingClientRect();
    const column = Math.floor((event.clientX - frame.left - box.left) / box.cell[0]);
    const row = Math.floor((box.top + box.height - (event.clientY - frame.top)) / box.cell[1]);
    return column >= 0 && row >= 0 && column < box.counts[0] && row < box.counts[1] ? [column, row] : null;
  }

  moveSelection(event) {
    if (event.key === "Enter" && this.selected) {
      this.pin(this.selected);
      return;
    }
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
    const { unit } = QUANTITIES.speed;
    const mark = this.field.isVector ? "" : "′";
    const parts = ["u", "v", "w"].map((name) => `${name}${mark} ${significant(statistics[name])}`).join(", ");
    return `${where}: ${statistics.good} of ${statistics.count} vectors valid; mean ${parts} ${unit}; `
      + `rms ${significant(statistics.rms)}, largest ${significant(statistics.largest)} ${unit}.`;
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
