"use strict";
// Follow streamlines through a field, in a slice or in space.

/** Step of the integration, and longest streamline to either side [cells]. */
const STREAM_STEP = 0.2, STREAM_LENGTH = 60;
/** Speed below which a streamline ends, as a share of the largest. */
const STREAM_STILL = 0.003;

/** Return the direction of a field at a place [cells], of length 1, or null where it ends. */
function directionAt(sample, place, still) {
  const velocity = sample(place);
  if (velocity === null) return null;
  const size = Math.hypot(...velocity);
  return size > still ? velocity.map((value) => value / size) : null;
}

/** Follow a streamline one way by the midpoint rule; `stop` says where another one is near. */
function follow(sample, seed, sign, still, stop) {
  const places = [];
  let place = seed;
  for (let k = 0; k < STREAM_LENGTH / STREAM_STEP; k += 1) {
    const first = directionAt(sample, place, still);
    if (first === null) break;
    const half = place.map((value, axis) => value + 0.5 * sign * STREAM_STEP * first[axis]);
    const direction = directionAt(sample, half, still);
    if (direction === null) break;
    place = place.map((value, axis) => value + sign * STREAM_STEP * direction[axis]);
    if (sample(place) === null || stop(place)) break;
    places.push(place);
  }
  return places;
}

/** Return streamlines that keep apart: lists of places [cells].
 *
 * `sample` returns the velocity at a place [cells of any axes], or null outside; `counts` is the number of cells along
 * each axis, `apart` the distance between streamlines [cells].
 */
function streamlines(sample, counts, apart, largest, most) {
  const taken = new Map();
  const key = (place) => place.map((value) => Math.floor((value + 0.5) / apart)).join(",");
  const seeds = seedPlaces(counts, apart);
  const found = [];
  for (const seed of seeds) {
    if (found.length >= most) break;
    if (taken.has(key(seed)) || sample(seed) === null) continue;
    const own = found.length;
    let here = null;
    const stop = (place) => {
      const cell = key(place);
      if (cell === here) return false;
      if (taken.has(cell)) return true; // its own path closes, or another streamline is near
      taken.set(cell, own);
      here = cell;
      return false;
    };
    here = key(seed);
    taken.set(here, own);
    const ahead = follow(sample, seed, 1, STREAM_STILL * largest, stop);
    here = key(seed);
    const behind = follow(sample, seed, -1, STREAM_STILL * largest, stop);
    const places = [...behind.reverse(), seed, ...ahead];
    if (places.length * STREAM_STEP > 1.5 * apart) found.push(places);
  }
  return found;
}

/** Return places [cells] on an even grid, in an order that spreads them. */
function seedPlaces(counts, apart) {
  let places = [[]];
  for (const count of counts) {
    const some = Math.max(Math.floor(count / apart), 1);
    const row = Array.from({ length: some }, (_, k) => ((k + 0.5) * count) / some - 0.5);
    places = places.flatMap((place) => row.map((value) => [...place, value]));
  }
  const stride = Math.max(Math.round(places.length * 0.382), 1);
  const order = [];
  for (let start = 0; start < stride; start += 1) {
    for (let k = start; k < places.length; k += stride) order.push(places[k]);
  }
  return order;
}
