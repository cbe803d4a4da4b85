"use strict";
// Decode the vector fields of the page, which lfpiv/report/fields.py encodes.

/** Stored integer that means not-a-number. */
const NO_NUMBER = -32768;
/** How each quantity is written, from the page: label, unit, factor from SI, and whether it is signed. */
let QUANTITIES = {};
/** Velocity of one voxel, in the unit of the velocities. */
let VOXEL = 0;
/** Quantities that follow from stored ones: their parts. */
const MAGNITUDES = { speed: ["u", "v", "w"], vorticity: ["vorticity_x", "vorticity_y", "vorticity_z"] };
/** Velocity component along each axis. */
const COMPONENT = { x: "u", y: "v", z: "w" };
/** Axes in the order of the stored values. */
const AXES = ["z", "y", "x"];

/** Return the bytes that a script element holds as gzipped base64. */
async function unpack(id) {
  const text = atob(document.getElementById(id).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** A vector field: that of a pair, the mean over pairs, or their fluctuation. */
class Field {
  constructor(entry, block) {
    this.label = entry.label;
    this.isVector = entry.kind === "velocity";
    this.entry = entry;
    this.block = block;
    this.axis = { x: entry.x, y: entry.y, z: entry.z };
    this.shape = AXES.map((name) => this.axis[name].length);
    this.size = this.shape[0] * this.shape[1] * this.shape[2];
    this.valid = new Int16Array(block, entry.valid, this.size);
    this.masked = "masked" in entry ? new Int16Array(block, entry.masked, this.size) : null;
    this.cache = {};
  }

  /** Return the names of the quantities that the field has. */
  quantities() {
    const known = (name) => name in this.entry.values;
    return Object.keys(QUANTITIES).filter((name) => (MAGNITUDES[name] || [name]).every(known));
  }

  /** Return the label of a quantity with its unit. */
  title(name) {
    const { label, unit } = QUANTITIES[name];
    if (this.isVector) return `${label} [${unit}]`;
    return name === "speed" ? `all components [${unit}]` : `${label}′ [${unit}]`;
  }

  isSigned(name) {
    return this.isVector && QUANTITIES[name].signed;
  }

  /** Return all values of a quantity, in the order (z, y, x). */
  values(name) {
    if (!(name in this.cache)) this.cache[name] = name in MAGNITUDES ? this.magnitude(name) : this.decode(name);
    return this.cache[name];
  }

  decode(name) {
    const { offset } = this.entry.values[name];
    const scale = this.entry.values[name].scale * QUANTITIES[name].factor;
    const stored = new Int16Array(this.block, offset, this.size);
    return Float32Array.from(stored, (value) => (value === NO_NUMBER ? NaN : value * scale));
  }

  magnitude(name) {
    const [x, y, z] = MAGNITUDES[name].map((part) => this.values(part));
    return x.map((value, i) => Math.hypot(value, y[i], z[i]));
  }

  /** Return the standard deviation of a velocity component at an index; 0 where it is not known. */
  velocityError(index) {
    if (!("uncertainty" in this.entry.values)) return 0;
    const error = this.values("uncertainty")[index] * VOXEL;
    return Number.isFinite(error) ? error : 0;
  }

  /** Return the index of the value at (z, y, x) = (k, j, i). */
  index(k, j, i) {
    return (k * this.shape[1] + j) * this.shape[2] + i;
  }

  /** Return whether a vector is masked: without fluid. */
  isMasked(index) {
    return this.masked !== null && this.masked[index] !== 0;
  }

  /** Return whether a vector is valid and finite. */
  isValid(index) {
    return this.valid[index] !== 0 && Number.isFinite(this.values("speed")[index]);
  }

  /** Return the quantile (0 to 1) of the magnitude of a quantity over the valid vectors; 0 without any. */
  magnitudeQuantile(name, quantile) {
    const key = `${name} quantile ${quantile}`;
    if (!(key in this.cache)) {
      const values = this.values(name);
      const known = values.map(Math.abs).filter((value, index) => this.isValid(index) && Number.isFinite(value)).sort();
      this.cache[key] = known.length ? known[Math.round((known.length - 1) * quantile)] : 0;
    }
    return this.cache[key];
  }

  /** Return the quantile of the positive values of a quantity at the valid vectors, or of the magnitude without any. */
  positiveQuantile(name, quantile) {
    const known = this.values(name).filter((value, index) => value > 0 && this.isValid(index)).sort();
    return known.length ? known[Math.round((known.length - 1) * quantile)] : this.magnitudeQuantile(name, quantile);
  }

  /** Return the spacing of the vectors along an axis [mm]; that of another axis where it has a single layer. */
  spacing(name) {
    const spacing = (axis) => (axis.length > 1 ? (axis[axis.length - 1] - axis[0]) / (axis.length - 1) : NaN);
    const known = [this.axis[name], ...Object.values(this.axis)].map(spacing).filter(Number.isFinite);
    return known.length ? known[0] : 1;
  }

  /** Return the quantile of the speed in the plane of a slice over the valid vectors of the whole field. */
  inPlaneQuantile(names, quantile) {
    const [a, b] = names.map((name) => this.values(name));
    const known = a.map((value, i) => Math.hypot(value, b[i])).filter((value, i) => this.isValid(i)).sort();
    return known.length ? known[Math.round((known.length - 1) * quantile)] : 0;
  }

  /** Return counts, mean velocity, rms and largest speed of the valid vectors of a slice; masked ones do not count. */
  sliceStatistics(normal, layer) {
    const sums = { count: 0, good: 0, u: 0, v: 0, w: 0, square: 0, largest: 0 };
    this.forSlice(normal, layer, (index) => {
      if (this.isMasked(index)) return;
      sums.count += 1;
      if (!this.isValid(index)) return;
      const speed = this.values("speed")[index];
      sums.good += 1;
      for (const name of ["u", "v", "w"]) sums[name] += this.values(name)[index];
      sums.square += speed * speed;
      sums.largest = Math.max(sums.largest, speed);
    });
    const mean = (total) => (sums.good ? total / sums.good : NaN);
    return {
      count: sums.count, good: sums.good, u: mean(sums.u), v: mean(sums.v), w: mean(sums.w),
      rms: Math.sqrt(mean(sums.square)), largest: sums.good ? sums.largest : NaN,
    };
  }

  /** Call `visit(index, column, row)` for every vector of a slice. */
  forSlice(normal, layer, visit) {
    const [across, up] = sliceAxes(normal);
    for (let row = 0; row < this.axis[up].length; row += 1) {
      for (let column = 0; column < this.axis[across].length; column += 1) {
        const position = { [normal]: layer, [across]: column, [up]: row };
        visit(this.index(position.z, position.y, position.x), column, row);
      }
    }
  }
}

/** Return the horizontal and the vertical axis of a slice. */
function sliceAxes(normal) {
  return { z: ["x", "y"], y: ["x", "z"], x: ["y", "z"] }[normal];
}

/** Interpolate a colour map, given by stops #rrggbb, at a share from 0 to 1; return red, green and blue. */
function colourParts(stops, share) {
  const place = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(place), stops.length - 2);
  const part = (stop, k) => parseInt(stops[stop].slice(1 + 2 * k, 3 + 2 * k), 16);
  return [0, 1, 2].map((k) => Math.round(part(low, k) + (place - low) * (part(low + 1, k) - part(low, k))));
}

/** Return a colour of a colour map as CSS. */
function colourAt(stops, share) {
  return `rgb(${colourParts(stops, share).join(",")})`;
}

/** Format a number with significant digits, as `markup.significant` does for the tables. */
function significant(value, digits = 3) {
  if (!Number.isFinite(value)) return "–";
  const rounded = Number(value.toPrecision(digits));
  const size = Math.abs(rounded);
  if (size === 0) return "0";
  const text = size >= 1e-4 && size < 1e6 ? String(rounded) : rounded.toExponential().replace("e+", "e");
  return text.replace(/-/g, "−");
}

/** Format a number with decimals. */
function fixed(value, decimals) {
  return Number.isFinite(value) ? value.toFixed(decimals).replace("-", "−") : "–";
}

/** Set the options of a select element, and keep its value if it is still among them. */
function fillOptions(select, entries) {
  const before = select.value;
  select.replaceChildren(...entries.map(([value, text]) => new Option(text, value)));
  if (entries.some(([value]) => String(value) === before)) select.value = before;
}
