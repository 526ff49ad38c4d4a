// The smooth curve through points that is used for tracking: a natural cubic spline whose parameter increases by the
// square root of the distance between points (video/curved_axis.py).
const STEP_PX = 4;  // approximate spacing of its points: with straight segments the error at a radius of 100 px is below 0.05 px

export function curveThrough(points) {
  const knots = knotsOf(points);
  if (points.length < 3 || !knots) return points;
  const bends = [0, 1].map((k) => bendsOf(knots, points.map((point) => point[k])));
  const places = [];
  for (let i = 0; i + 1 < points.length; i++) {
    const count = Math.max(1, Math.ceil(distance(points[i], points[i + 1]) / STEP_PX));
    for (let j = 0; j < count; j++) places.push([0, 1].map((k) => valueAt(knots, points.map((point) => point[k]), bends[k], i, j / count)));
  }
  return [...places, points.at(-1)];
}

// Where a bend is added: the middle of the longest segment, and its index.
export function middleOfLongest(points) {
  const lengths = points.slice(1).map((point, i) => distance(points[i], point));
  const i = lengths.indexOf(Math.max(...lengths)), knots = knotsOf(points);
  if (!knots) return {index: i + 1, point: points[i].map((v, k) => (v + points[i + 1][k]) / 2)};
  const column = (k) => points.map((point) => point[k]);
  return {index: i + 1, point: [0, 1].map((k) => valueAt(knots, column(k), bendsOf(knots, column(k)), i, 0.5))};
}

// Parameter at each point; null if two points coincide, because no curve passes through them.
function knotsOf(points) {
  const knots = [0];
  for (let i = 1; i < points.length; i++) knots.push(knots[i - 1] + Math.sqrt(distance(points[i - 1], points[i])));
  return knots.some((knot, i) => i && knot === knots[i - 1]) ? null : knots;
}

const distance = ([x0, y0], [x1, y1]) => Math.hypot(x1 - x0, y1 - y0);

// Second derivatives at the knots, zero at both ends: solution of a tridiagonal system.
function bendsOf(knots, values) {
  const n = values.length, bends = Array(n).fill(0), upper = Array(n).fill(0);
  for (let i = 1; i < n - 1; i++) {
    const before = knots[i] - knots[i - 1], after = knots[i + 1] - knots[i];
    const slope = (values[i + 1] - values[i]) / after - (values[i] - values[i - 1]) / before;
    const pivot = 2 * (before + after) - before * upper[i - 1];
    upper[i] = after / pivot;
    bends[i] = (6 * slope - before * bends[i - 1]) / pivot;
  }
  for (let i = n - 2; i > 0; i--) bends[i] -= upper[i] * bends[i + 1];
  return bends;
}

function valueAt(knots, values, bends, i, part) {
  const wide = knots[i + 1] - knots[i], left = 1 - part;
  return left * values[i] + part * values[i + 1] + (wide * wide / 6) * ((left ** 3 - left) * bends[i] + (part ** 3 - part) * bends[i + 1]);
}
