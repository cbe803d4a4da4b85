"use strict";
// Draw on a canvas: lines with an outline, arrows, axes, colour bars, and fields in colour.

/** Colours of measured and of replaced vectors: the line and its outline, which shows on dark and light cells. */
const ARROW = { measured: ["#0b0f14", "#ffffff"], replaced: ["#ffffff", "#0b0f14"] };
/** Largest number of samples across a cell of a smoothly coloured field. */
const SAMPLES = 12;

function line(context, from, to) {
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}

/** Stroke a path twice: its outline, then the line. */
function outlined(context, path, [ink, outline], width) {
  context.lineJoin = "round";
  context.lineCap = "round";
  for (const [colour, size] of [[outline, width + 2], [ink, width]]) {
    context.strokeStyle = colour;
    context.lineWidth = size;
    context.stroke(path);
  }
  context.lineCap = "butt";
}

/** Draw an arrow with its middle at `centre`; arrows shorter than a pixel and a half are a dot. */
function arrow(context, centre, step, head, colours, width = 1.3) {
  const length = Math.hypot(...step);
  if (!Number.isFinite(length)) return;
  const path = new Path2D();
  if (length < 1.5) {
    path.moveTo(...centre);
    path.lineTo(centre[0] + 0.01, centre[1]);
    outlined(context, path, colours, width);
    return;
  }
  const along = step.map((value) => value / length);
  const from = centre.map((value, k) => value - step[k] / 2);
  const tip = centre.map((value, k) => value + step[k] / 2);
  const barb = Math.min(head, length / 2);
  path.moveTo(...from);
  path.lineTo(...tip);
  for (const side of [0.5, -0.5]) {
    path.moveTo(...tip);
    path.lineTo(tip[0] - barb * (along[0] + side * along[1]), tip[1] - barb * (along[1] - side * along[0]));
  }
  outlined(context, path, colours, width);
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

/** Return a value between the centres of cells, in units of cells: linear, and the nearest beside unknown ones. */
function between(values, columns, rows, column, row) {
  const [x, y] = [Math.min(Math.max(column, 0), columns - 1), Math.min(Math.max(row, 0), rows - 1)];
  const [i, j] = [Math.min(Math.floor(x), columns - 2), Math.min(Math.floor(y), rows - 2)].map((k) => Math.max(k, 0));
  const [right, up] = [Math.min(i + 1, columns - 1), Math.min(j + 1, rows - 1)];
  const [a, b] = [x - i, y - j];
  const mean = (1 - b) * ((1 - a) * values[j * columns + i] + a * values[j * columns + right])
    + b * ((1 - a) * values[up * columns + i] + a * values[up * columns + right]);
  return Number.isFinite(mean) ? mean : values[Math.round(y) * columns + Math.round(x)];
}

/** Paint a field of `columns` by `rows` values into a box, with a value for each cell or interpolated between them. */
function paintField(context, values, [columns, rows], [left, top, width, height], share, stops, smooth) {
  const across = smooth ? Math.max(Math.min(Math.ceil(width / columns / 2), SAMPLES), 1) : 1;
  const table = Array.from({ length: 256 }, (_, k) => colourParts(stops, k / 255));
  const picture = document.createElement("canvas");
  picture.width = columns * across;
  picture.height = rows * across;
  const image = new ImageData(picture.width, picture.height);
  for (let y = 0; y < picture.height; y += 1) for (let x = 0; x < picture.width; x += 1) {
    const column = (x + 0.5) / across - 0.5;
    const row = rows - 1 - ((y + 0.5) / across - 0.5);
    const value = smooth ? between(values, columns, rows, column, row) : values[row * columns + column];
    if (!Number.isFinite(value)) continue;
    const colour = table[Math.round(255 * Math.min(Math.max(share(value), 0), 1))];
    image.data.set([...colour, 255], 4 * (y * picture.width + x));
  }
  picture.getContext("2d").putImageData(image, 0, 0);
  context.imageSmoothingEnabled = smooth;
  context.drawImage(picture, left, top, width, height);
}

/** Draw the frame of a plot with ticks and titles; `box` has left, top, width and height, `ends` those of both axes. */
function drawAxes(context, box, ends, titles, ink) {
  context.strokeStyle = ink;
  context.fillStyle = ink;
  context.lineWidth = 1;
  context.strokeRect(box.left, box.top, box.width, box.height);
  const place = (axis, value, length) => ((value - ends[axis][0]) / (ends[axis][1] - ends[axis][0])) * length;
  const marks = (axis, length, apart) => ticks(...ends[axis], Math.max(Math.min(Math.floor(length / apart), 8), 3));
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const value of marks(0, box.width, 60)) {
    const x = box.left + place(0, value, box.width);
    line(context, [x, box.top + box.height], [x, box.top + box.height + 4]);
    context.fillText(significant(value, 6), x, box.top + box.height + 6);
  }
  context.fillText(titles[0], box.left + box.width / 2, box.top + box.height + 22);
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (const value of marks(1, box.height, 40)) {
    const y = box.top + box.height - place(1, value, box.height);
    line(context, [box.left - 4, y], [box.left, y]);
    context.fillText(significant(value, 6), box.left - 6, y);
  }
  context.save();
  context.translate(box.left - 46, box.top + box.height / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(titles[1], 0, 0);
  context.restore();
}

/** Draw a colour bar with ticks and a title. */
function drawBar(context, [left, top, width], { stops, low, high }, title, ink) {
  const steps = 160;
  for (let k = 0; k < steps; k += 1) {
    context.fillStyle = colourAt(stops, (k + 0.5) / steps);
    context.fillRect(left + (k * width) / steps, top, width / steps + 0.6, 10);
  }
  context.strokeStyle = ink;
  context.lineWidth = 1;
  context.strokeRect(left, top, width, 10);
  context.fillStyle = ink;
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const value of ticks(low, high, 4)) {
    const x = left + ((value - low) / (high - low)) * width;
    line(context, [x, top + 10], [x, top + 13]);
    context.fillText(significant(value, 6), x, top + 14);
  }
  context.fillText(title, left + width / 2, top + 30);
}

/** Size a canvas for the screen's pixels; return its context, scaled to CSS pixels. */
function prepare(canvas, width, height) {
  const pixelRatio = window.devicePixelRatio || 1;
  canvas.width = Math.round(width * pixelRatio);
  canvas.height = Math.round(height * pixelRatio);
  canvas.style.height = `${height}px`;
  const context = canvas.getContext("2d");
  context.scale(pixelRatio, pixelRatio);
  context.font = "12px system-ui, sans-serif";
  return context;
}

/** Return the largest 1, 2 or 5 times a power of ten that does not exceed a value. */
function roundBelow(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].find((step) => step * power <= value * (1 + 1e-9)) * power;
}

/** Return about `count` round values between two ends, at least three where there are. */
function ticks(low, high, count, tries = 3) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= rough * (1 - 1e-9)) * power;
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    found.push(Number((k * step).toPrecision(12)));
  }
  return found.length < 3 && tries > 0 ? ticks(low, high, 1.5 * count, tries - 1) : found;
}
