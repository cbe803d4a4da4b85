"use strict";
// Follow streamlines through a field, in a slice or in space.

/** Step of the integration, and longest streamline to either side [cells]. */
const STREAM_STEP = 0.1, STREAM_LENGTH = 60;
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
 * each axis, `apart` the distance between streamlines [cells]. A streamline ends where it comes near another one or
 * itself, and where it circles within the distance; it has to be longer than the distance.
 */
function streamlines(sample, counts, apart, largest, most) {
  const taken = new Set();
  const key = (place) => place.map((value) => Math.floor((value + 0.5) / apart)).join(",");
  const found = [];
  for (const seed of seedPlaces(counts, apart)) {
    if (found.length >= most) break;
    if (taken.has(key(seed)) || sample(seed) === null) continue;
    const own = new Set([key(seed)]);
    const oneWay = (sign) => {
      let here = key(seed), stay = 0;
      return follow(sample, seed, sign, STREAM_STILL * largest, (place) => {
        const cell = key(place);
        stay = cell === here ? stay + 1 : 0;
        if (cell === here) return stay * STREAM_STEP > 2 * apart;
        if (taken.has(cell) || own.has(cell)) return true;
        own.add(cell);
        here = cell;
        return false;
      });
    };
    const ahead = oneWay(1);
    const places = [...oneWay(-1).reverse(), seed, ...ahead];
    if (own.size < 3) continue;
    for (const cell of own) taken.add(cell);
    found.push(places);
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
