// @ts-check
/**
 * Exact linear theory of a device behind a delay and a sampled virtual wall. No access to a page, no dependency.
 *
 * A loop has the keys of a device file (docs/devices.md) and is in SI. Inside, time is counted in sampling periods and
 * the mass is 1 (Table 3.1): alpha = K T^2/m, beta = B T/m, gamma = k T^2/m, delta = b T/m. On the unit circle,
 * z = exp(j theta), the characteristic equation is alpha + beta N = H, with N the velocity filter and H = -1/G of the
 * sampled device: beta = Im H/Im N, alpha = Re H - beta Re N (D-decomposition).
 *
 * Source: Hulin 2017, ch. 3 to 5. The same numbers as `pipeline.Loop` in Python.
 */

/**
 * @typedef {{kind: string, samples?: number, order?: number, cutoff_hz?: number, b?: number[], a?: number[],
 *   acceleration?: number, noise?: number}} VelocityFilter
 * @typedef {{frequency_hz: number, damping_ratio: number, mass: number, sensor?: string, load_damping?: number}} Mode
 * @typedef {{mass: number, damping?: number, stiffness?: number}} Operator
 * @typedef {{velocity?: VelocityFilter | null, actuator_lag_s?: number, force_gain?: number, mode?: Mode | null,
 *   operator?: Operator | null}} Parts
 * @typedef {Parts & {mass?: number, damping?: number, stiffness?: number, sampling_period_s?: number,
 *   delay_samples?: number, jitter_samples?: number[], motion?: string, loop?: Parts, experiment?: any[]}} DeviceFile
 * @typedef {{order: number, value: (theta: number, out: Float64Array) => void, step: Float64Array, gain: Float64Array,
 *   row: Float64Array, direct: number}} Filter
 * @typedef {{stiffness: number, damping: number, period: number, motion: string}} Units
 * @typedef {{n: number, A: Float64Array, B: Float64Array, C: Float64Array, gamma: number, delta: number, lag: number,
 *   near: number, atLoad: boolean, mechanical: number, whole: number, fraction: number, delay: number, q: number,
 *   step: Float64Array, bottom: Float64Array, topOld: Float64Array | null,
 *   topNew: Float64Array, filter: Filter, units: Units, file: DeviceFile, pieces?: any, curve?: Curve}} Sampled
 * @typedef {{t0: number, t1: number, b0: number, b1: number, a0: number, a1: number, turn: number, edge: boolean}} Cell
 * @typedef {{value: number, slope: number, bend: number, bendSlope: number, turn: number}} Line
 * @typedef {{cells: Cell[], lines: Line[], soft: number[][], turning: number[], nodes: {theta: number, v: Float64Array, event: number}[]}} Curve
 */

/** Samples of delay, and that a filter remembers, at most. */
const LARGEST_DELAY = 256, LARGEST_FILTER = 96;
/** Damping ratio of a mode without any: without loss its zeros lie on the unit circle. As in Python. */
const LEAST_RATIO = 1e-12;
/** Samples after which a response that still moves is given up. */
const LONGEST = 1 << 22;
/** Motion below which a response is no longer followed for overshoot; an overshoot up to ten times this is none. */
const QUIET = 1e-13;
/** Motion below which nothing is added to energies. */
const FADED = 1e-9;
/** Samples after which it is first looked whether the slowest pole, with its pair, is all that moves. */
const FIRST_LOOK = 512;
/** Logarithm of the size, over that of the slowest, to which all other modes have faded then. */
const GONE = -69;
/** Distance of the spectral radius from 1 below which costs would be rounding errors. */
const MARGINAL = 1e-12;

// ---------------------------------------------------------------------------------------------------- device file

/**
 * Return a number of a device file, or throw an error that names it.
 * @param {string} name @param {any} value @param {number} least @param {boolean} [positive] @returns {number}
 */
function number(name, value, least, positive = false) {
  if (typeof value !== "number" || !Number.isFinite(value) || value < least || (positive && value <= least)) {
    throw new RangeError(`${name}: found ${JSON.stringify(value) ?? "nothing"}; expected a finite number ` +
      `${positive ? "above" : "of at least"} ${least}`);
  }
  return value;
}

/**
 * Return the loop of a device file with all its parts at the top, those of its first experiment included.
 * @param {DeviceFile} file @returns {DeviceFile}
 */
export function flattened(file) {
  if (file === null || typeof file !== "object") throw new TypeError("loop: expected the entries of a device file");
  const { experiment, loop, ...device } = file, { loop: ofExperiment, ...first } = (experiment ?? [])[0] ?? {};
  const flat = { ...device, ...first, ...(loop ?? {}), ...(ofExperiment ?? {}) };
  const jitter = flat.jitter_samples ?? [];
  if (jitter.length) flat.delay_samples = jitter.reduce((sum, d) => sum + d, 0) / jitter.length;
  return flat;
}

/**
 * Return the parts of a loop that linear theory cannot include.
 * @param {DeviceFile} file @returns {string[]}
 */
export function leftOut(file) {
  const flat = /** @type {any} */ (flattened(file)), kind = flat.velocity?.kind;
  return [
    ...(kind === "foaw" || kind === "levant" ? ["velocity"] : []), ...(flat.friction ? ["friction"] : []),
    ...(new Set(flat.jitter_samples ?? []).size > 1 ? ["jitter"] : []),
  ];
}

/**
 * Return the sampled loop of a device file, without its wall; one that is prepared already is returned as it is.
 * @param {DeviceFile | Sampled} file @returns {Sampled}
 */
export function prepare(file) {
  if ("topNew" in file) return file;
  const flat = flattened(file), T = number("sampling_period_s", flat.sampling_period_s, 0, true);
  const own = number("mass", flat.mass, 0, true), b = number("damping", flat.damping ?? 0, 0);
  const gain = number("force_gain", flat.force_gain ?? 1, 0, true), k = number("stiffness", flat.stiffness ?? 0, 0);
  const delay = number("delay_samples", flat.delay_samples, 0);
  if (delay > LARGEST_DELAY) throw new RangeError(`delay_samples: found ${delay}; expected at most ${LARGEST_DELAY}`);
  const lag = number("actuator_lag_s", flat.actuator_lag_s ?? 0, 0) / T;
  const { mass: hand, damping: grip, stiffness: pull } = flat.operator ?? { mass: 0 };
  const mass = own + number("operator.mass", hand, 0), damping = b + number("operator.damping", grip ?? 0, 0);
  const gamma = (k + number("operator.stiffness", pull ?? 0, 0)) * T * T / mass, delta = damping * T / mass;
  if (gamma > Math.PI ** 2 + delta ** 2 / 4) {
    throw new RangeError(`stiffness: the device swings faster than it is sampled (k T^2/m = ${gamma.toPrecision(4)})`);
  }
  const device = stateSpace(flat.mode ?? null, { own, b, mass, T, gamma, delta, lag });
  const whole = Math.floor(delay), fraction = delay - whole;
  return sampledDevice({
    ...device, gamma, delta, lag, whole, fraction, delay, file: flat,
    near: (b - (flat.mode?.load_damping ?? 0)) * T / mass, filter: velocityFilter(flat.velocity ?? null, T),
    units: { stiffness: mass / gain / T ** 2, damping: mass / gain / T, period: T, motion: flat.motion ?? "translation" },
  });
}

/**
 * Return x' = A x + B u, position = C x, about the centre of mass, in units of mass and sampling period.
 * @param {Mode | null} mode @param {{own: number, b: number, mass: number, T: number, gamma: number, delta: number,
 *   lag: number}} numbers
 */
function stateSpace(mode, { own, b, mass, T, gamma, delta, lag }) {
  const mechanical = mode ? 4 : 2, n = mechanical + (lag > 0 ? 1 : 0);
  const A = new Float64Array(n * n), B = new Float64Array(n), C = new Float64Array(n), force = new Float64Array(n);
  A[1] = 1, A[n] = -gamma, A[n + 1] = -delta, C[0] = 1, force[1] = 1;
  let loadDamping = 0;
  if (mode) {
    const heavy = number("mode.mass", mode.mass, 0, true), turn = 2 * Math.PI * number("mode.frequency_hz", mode.frequency_hz, 0, true);
    const ratio = Math.max(number("mode.damping_ratio", mode.damping_ratio, 0), LEAST_RATIO), bl = number("mode.load_damping", mode.load_damping ?? 0, 0);
    if (heavy >= own) throw new RangeError(`mode.mass: found ${heavy}; expected less than the whole mass, ${own}`);
    if (bl > b) throw new RangeError(`mode.load_damping: found ${bl}; expected at most the whole damping, ${b}`);
    const reduced = heavy * (own - heavy) / own, load = heavy / mass, near = 1 - load;
    const spring = reduced * turn ** 2 * T * T / mass, damper = 2 * ratio * turn * reduced * T / mass;
    loadDamping = bl * T / mass;
    const motor = [1, -load / near];
    motor.forEach((share, i) => {
      C[2 * i] = share;
      A[n + 2 * i] = -share * gamma, A[n + 2 * i + 1] = -share * (delta - loadDamping);
    });
    A[2 * n + 3] = 1, force[3] = -1;
    for (let j = 0; j < 4; j++) A[3 * n + j] = -A[n + j];
    A[3 * n + 2] -= spring * (1 / load + 1 / near), A[3 * n + 3] -= damper * (1 / load + 1 / near);
    for (const j of [1, 3]) A[n + j] -= loadDamping, A[3 * n + j] -= near / load * loadDamping;
    if (mode.sensor === "load") C[2] = 1;
  }
  if (lag > 0) {
    for (let i = 0; i < n - 1; i++) A[i * n + n - 1] = force[i];
    A[n * n - 1] = -1 / lag, B[n - 1] = 1 / lag;
  } else B.set(force);
  return { n, A, B, C, mechanical, atLoad: mode?.sensor === "load" };
}

/**
 * Return a loop with its motion over a sample: a step from its state and the forces that act (with a fraction of a sample
 * of delay the older, then the newer one) to the next state, and the transfer function of each force.
 * @param {any} loop @returns {Sampled}
 */
function sampledDevice(loop) {
  const { n, A, B, fraction } = loop, q = n + (fraction > 0 ? 2 : 1), step = new Float64Array(n * q);
  const E = moved(A, B, n, 1).change, later = moved(A, B, n, 1 - fraction), first = moved(A, B, n, fraction).gain;
  const older = fraction > 0 ? first.map((value, i) => value + sum(n, (j) => later.change[i * n + j] * first[j])) : null;
  for (let i = 0; i < n; i++) {
    step.set(E.subarray(i * n, i * n + n), i * q), step[i * q + i] += 1;
    if (older) step[i * q + n] = older[i];
    step[i * q + q - 1] = later.gain[i];
  }
  const { bottom, adjugates, scale } = resolvent(E, n);
  if (!loop.gamma) bottom[0] = 0;
  const top = (gain) => Float64Array.from(adjugates, (M) =>
    sum(n, (i) => loop.C[i] * scale[i] * sum(n, (j) => M[i * n + j] * gain[j] / scale[j])));
  return { ...loop, q, step, bottom, topOld: older && top(older), topNew: top(later.gain) };
}

/** @param {number} n @param {(i: number) => number} term @returns {number} */
function sum(n, term) {
  let total = 0;
  for (let i = 0; i < n; i++) total += term(i);
  return total;
}

/**
 * Return the product of matrices of n rows and n columns, or of n rows, so many between, and so many columns.
 * @param {Float64Array} X @param {Float64Array} Y @param {number} n @param {number} [between] @param {number} [columns]
 */
function product(X, Y, n, between = n, columns = n) {
  const result = new Float64Array(n * columns);
  for (let i = 0; i < n; i++) {
    for (let k = 0; k < between; k++) {
      const x = X[i * between + k];
      if (x) for (let j = 0; j < columns; j++) result[i * columns + j] += x * Y[k * columns + j];
    }
  }
  return result;
}

/**
 * Return exp(M) - 1, by its series and doubling: (1 + E)^2 - 1 = 2 E + E^2 loses no digits of a slow motion.
 * @param {Float64Array} M @param {number} n @returns {Float64Array}
 */
export function exponential(M, n) {
  const norm = Math.max(...Array.from({ length: n }, (_, i) => sum(n, (j) => Math.abs(M[i * n + j]))));
  const doublings = Math.max(0, Math.ceil(Math.log2(norm)) + 2), X = M.map((value) => value / 2 ** doublings);
  let E = X, term = X;
  for (let k = 2; k < 16; k++) {
    term = product(term, X, n).map((value) => value / k);
    E = E.map((value, i) => value + term[i]);
  }
  for (let k = 0; k < doublings; k++) {
    const square = product(E, E, n);
    E = E.map((value, i) => 2 * value + square[i]);
  }
  return E;
}

/** @param {Float64Array} A @param {Float64Array} B @param {number} n @returns {Float64Array} matrix of a motion with a constant input */
function augmented(A, B, n) {
  const M = new Float64Array((n + 1) ** 2);
  for (let i = 0; i < n; i++) M.set(A.subarray(i * n, i * n + n), i * (n + 1)), M[i * (n + 1) + n] = B[i];
  return M;
}

/**
 * Return the motion over a time with a constant input: transition less 1, and gain.
 * @param {Float64Array} A @param {Float64Array} B @param {number} n @param {number} time
 */
function moved(A, B, n, time) {
  const E = exponential(augmented(A, B, n).map((value) => value * time), n + 1), change = new Float64Array(n * n);
  for (let i = 0; i < n; i++) change.set(E.subarray(i * (n + 1), i * (n + 1) + n), i * n);
  return { change, gain: B.map((_, i) => E[i * (n + 1) + n]) };
}

/**
 * Balance a matrix in place by powers of two; return the scales (Parlett and Reinsch 1969).
 * @param {Float64Array} M @param {number} n @returns {Float64Array}
 */
function balance(M, n) {
  const scale = new Float64Array(n).fill(1);
  for (let round = 0, changed = true; changed && round < 100; round++) {
    changed = false;
    for (let i = 0; i < n; i++) {
      let column = 0, row = 0;
      for (let j = 0; j < n; j++) if (j !== i) column += Math.abs(M[j * n + i]), row += Math.abs(M[i * n + j]);
      if (!column || !row) continue;
      const factor = 2 ** Math.round(Math.log2(row / column) / 2);
      if (column * factor + row / factor >= 0.95 * (column + row)) continue;
      changed = true;
      scale[i] *= factor;
      for (let j = 0; j < n; j++) M[j * n + i] *= factor;
      for (let j = 0; j < n; j++) M[i * n + j] /= factor;
    }
  }
  return scale;
}

/**
 * Return determinant and adjugate of x - E as polynomials in x, lowest power first (Faddeev and Leverrier).
 * @param {Float64Array} E @param {number} n
 */
function resolvent(E, n) {
  const M = E.slice(), scale = balance(M, n), bottom = new Float64Array(n + 1), adjugates = new Array(n);
  bottom[n] = 1;
  let R = new Float64Array(n * n);
  for (let k = 1; k <= n; k++) {
    R = product(M, R, n);
    for (let i = 0; i < n; i++) R[i * n + i] += bottom[n - k + 1];
    adjugates[n - k] = R;
    const P = product(M, R, n);
    bottom[n - k] = -sum(n, (i) => P[i * n + i]) / k;
  }
  return { bottom, adjugates, scale };
}

// ------------------------------------------------------------------------------------------------ velocity filter

/** Coefficients of Butterworth polynomials, lowest power first, by order. */
const BUTTERWORTH = [[1], [1, 1], [1, Math.SQRT2, 1], [1, 2, 2, 1],
  [1, Math.sqrt(4 + 2 * Math.SQRT2), 2 + Math.SQRT2, Math.sqrt(4 + 2 * Math.SQRT2), 1]];

/**
 * Return a velocity filter: N = (1 - 1/z) F and its slope on the circle, and F as a state space of (x_k - x_{k-1})/T.
 * @param {VelocityFilter | null} velocity @param {number} T @returns {Filter}
 */
function velocityFilter(velocity, T) {
  const kind = velocity?.kind ?? "difference";
  if (velocity && kind === "butterworth") {
    const order = number("velocity.order", velocity.order, 1), cutoff = number("velocity.cutoff_hz", velocity.cutoff_hz, 0, true);
    if (!BUTTERWORTH[order]) throw new RangeError(`velocity.order: found ${order}; expected 1, 2, 3 or 4`);
    if (cutoff * T >= 0.5) throw new RangeError(`velocity.cutoff_hz: found ${cutoff}; expected less than ${0.5 / T} Hz, half the sampling rate`);
    return butterworth(order, Math.tan(Math.PI * cutoff * T));
  }
  let b = velocity?.b ?? [1], a = velocity?.a ?? [1];
  if (kind === "difference") {
    const samples = number("velocity.samples", velocity?.samples ?? 1, 1);
    b = new Array(samples).fill(1 / samples), a = [1];
  } else if (velocity && kind === "kalman") {
    const index = number("velocity.acceleration", velocity.acceleration, 0, true) * T * T / number("velocity.noise", velocity.noise, 0, true);
    const root = Math.sqrt(index * (index + 8)), rest = 2 * index / (index + root), ratio = 4 / (4 + index + root);
    b = [2 * rest * rest], a = [1, rest * (1 + ratio) + 2 * rest * rest - 2, ratio * ratio];
  } else if (kind !== "coefficients") {
    if (kind !== "foaw" && kind !== "levant") throw new RangeError(`velocity.kind: found ${JSON.stringify(kind)}`);
    b = a = [1];  // adaptive filters are left out, as in Python
  }
  const form = directForm(b, a);
  return { ...form, value: (theta, out) => ratio(b, a, theta, out) };
}

/** @param {number[]} b @param {number[]} a @param {number} theta @param {Float64Array} out */
function ratio(b, a, theta, out) {
  const c = Math.cos(theta), s = -Math.sin(theta), half = Math.sin(theta / 2);
  const [br, bi, bsr, bsi] = horner(b, c, s).slice(), [ar, ai, asr, asi] = horner(a, c, s), size = ar * ar + ai * ai;
  const fr = (br * ar + bi * ai) / size, fi = (bi * ar - br * ai) / size, er = bsr - (fr * asr - fi * asi), ei = bsi - (fr * asi + fi * asr);
  const gr = (er * ar + ei * ai) / size, gi = (ei * ar - er * ai) / size, pr = 2 * half * half, pi = -s;
  out[4] = pr * fr - pi * fi, out[5] = pr * fi + pi * fr;
  const dr = pr * gr - pi * gi - fr, di = pr * gi + pi * gr - fi;  // by u = 1/z; times du/dtheta = -j u
  out[6] = dr * s + di * c, out[7] = -(dr * c - di * s);
}

const horned = new Float64Array(4);

/** @param {ArrayLike<number>} p @param {number} x @param {number} y @returns {Float64Array} value and slope at x + j y */
function horner(p, x, y) {
  let vr = 0, vi = 0, sr = 0, si = 0;
  for (let k = p.length - 1; k >= 0; k--) {
    const r = sr * x - si * y + vr;
    si = sr * y + si * x + vi, sr = r;
    const v = vr * x - vi * y + p[k];
    vi = vr * y + vi * x, vr = v;
  }
  horned[0] = vr, horned[1] = vi, horned[2] = sr, horned[3] = si;
  return horned;
}

/**
 * Return a filter b/a in powers of 1/z in transposed direct form.
 * @param {number[]} bs @param {number[]} as
 */
function directForm(bs, as) {
  if (!as[0]) throw new RangeError("velocity.a: its first coefficient must not be 0");
  const order = Math.max(bs.length, as.length) - 1;
  if (order > LARGEST_FILTER) throw new RangeError(`velocity: remembers ${order} samples; expected at most ${LARGEST_FILTER}`);
  const b = (i) => (bs[i] ?? 0) / as[0], a = (i) => (as[i] ?? 0) / as[0];
  const step = new Float64Array(order * order), gain = new Float64Array(order), row = new Float64Array(order);
  for (let i = 0; i < order; i++) {
    if (i + 1 < order) step[i * order + i + 1] = 1;
    step[i * order] -= a(i + 1), gain[i] = b(i + 1) - a(i + 1) * b(0);
  }
  if (order) row[0] = 1;
  return { order, step, gain, row, direct: b(0) };
}

/**
 * Return a Butterworth filter with the edge w = (z - 1)/(z + 1) at the cut-off. Its states are those of a trapezoidal
 * rule, s = (1 - A) x - B u: poles of a low cut-off keep their digits.
 * @param {number} order @param {number} edge @returns {Filter}
 */
function butterworth(order, edge) {
  const c = BUTTERWORTH[order].map((value, k) => value / edge ** k), n = order;
  /** @type {(theta: number, out: Float64Array) => void} */
  const value = (theta, out) => {
    const t = Math.tan(theta / 2), h = horner(c, 0, t), pr = h[0], pi = h[1], sr = h[2], si = h[3], size = pr * pr + pi * pi;
    // N = 2 w/((1 + w) P), w = j t; its slope is N (1/w - 1/(1 + w) - P'/P) dw/dtheta, dw/dtheta = j (1 + t^2)/2
    const lr = 2 * t * t / (1 + t * t), li = 2 * t / (1 + t * t);
    const nr = (lr * pr + li * pi) / size, ni = (li * pr - lr * pi) / size;
    const er = -1 / (1 + t * t) - (sr * pr + si * pi) / size, ei = t / (1 + t * t) - 1 / t - (si * pr - sr * pi) / size;
    const rate = (1 + t * t) / 2, xr = nr * er - ni * ei, xi = nr * ei + ni * er;
    out[4] = nr, out[5] = ni, out[6] = -xi * rate, out[7] = xr * rate;
  };
  const A = new Float64Array(n * n), input = (/** @type {number} */ i) => i === n - 1 ? edge : 0;
  for (let i = 0; i < n; i++) for (let j = 0; j < n; j++) A[i * n + j] = i === n - 1 ? -edge * BUTTERWORTH[n][j] : j === i + 1 ? edge : 0;
  const { bottom, adjugates, scale } = resolvent(A, n), size = sum(n + 1, (k) => bottom[k]);
  const inverse = A.map((_, at) => scale[Math.floor(at / n)] / scale[at % n] * sum(n, (k) => adjugates[k][at]) / size);
  const step = product(A.map((value, at) => value + (at % (n + 1) ? 0 : 1)), inverse, n);
  const gain = Float64Array.from({ length: n }, (_, i) => input(i) + step[i * n + n - 1] * edge);
  return { order, step, gain, row: inverse.slice(0, n), direct: inverse[n - 1] * edge, value };
}

// ------------------------------------------------------------------------------------------------------- boundary

/**
 * Set H, its slope by theta, N and its slope (real and imaginary parts) at an angle.
 * @param {Sampled} loop @param {number} theta @param {Float64Array} out
 */
function onCircle(loop, theta, out) {
  const half = Math.sin(theta / 2), x = -2 * half * half, y = Math.sin(theta), zr = 1 + x, zi = y;
  const h = horner(loop.bottom, x, y), br = h[0], bi = h[1], dbr = h[2], dbi = h[3];
  horner(loop.topNew, x, y);
  let tr = h[0], ti = h[1], dtr = h[2], dti = h[3];
  if (loop.topOld) {
    horner(loop.topOld, x, y);  // times 1/z = conj(z)
    const or = h[0], oi = h[1], dor = h[2], doi = h[3], vr = or * zr + oi * zi, vi = oi * zr - or * zi, er = dor - vr, ei = doi - vi;
    tr += vr, ti += vi, dtr += er * zr + ei * zi, dti += ei * zr - er * zi;
  }
  const size = tr * tr + ti * ti, cw = Math.cos(loop.whole * theta), sw = Math.sin(loop.whole * theta);
  const qr = (cw * tr + sw * ti) / size, qi = (sw * tr - cw * ti) / size;  // z^whole/top
  const hr = -(qr * br - qi * bi), hi = -(qr * bi + qi * br);
  // dH/dz = -q (whole b/z + b' - b top'/top), times dz/dtheta = j z
  const gr = (dtr * tr + dti * ti) / size, gi = (dti * tr - dtr * ti) / size, sr = loop.whole * (br * zr + bi * zi) + dbr - (br * gr - bi * gi);
  const si = loop.whole * (bi * zr - br * zi) + dbi - (br * gi + bi * gr);
  const ur = qr * sr - qi * si, ui = qr * si + qi * sr;
  out[0] = hr, out[1] = hi, out[2] = ur * zi + ui * zr, out[3] = -(ur * zr - ui * zi);
  loop.filter.value(theta, out);
}

/** Where beta is infinite, where it turns, where alpha turns and where it is 0: functions without poles. */
const EVENTS = [
  (v) => v[5],
  (v) => v[3] * v[5] - v[1] * v[7],
  (v) => v[5] * v[5] * v[2] - v[4] * (v[3] * v[5] - v[1] * v[7]) - v[1] * v[5] * v[6],
  (v) => v[0] * v[5] - v[1] * v[4],
];

/** Smallest angle, and that from pi, of a branch; between it and the end, alpha and beta go as its square. */
const SMALLEST = 1e-6;
/** Angles of each turn of the delayed force and the filter, before cells that bend are halved. */
const PER_TURN = 20;
/** Part of its values by which a cell may differ from the trapezoid of its slopes. */
const BENT = 0.03;

/**
 * Return values at angles that follow all branches: [theta, H, H', N, N', event], both ends left out.
 * @param {Sampled} loop @returns {{theta: number, v: Float64Array, event: number}[]}
 */
function nodes(loop) {
  const angles = new Set(), turns = PER_TURN * (loop.whole + 2 + loop.filter.order);
  // at no simple part of a turn, where a window's velocity is real or 0
  for (let k = 1; k <= turns; k++) angles.add((k - 0.382) * Math.PI / turns);
  for (let t = SMALLEST; t < 2 * Math.PI / turns; t *= 1.4) angles.add(t), angles.add(Math.PI - t);
  const [re, im] = eigenvalues(loop.A, loop.n);
  im.map((turn) => Math.acos(Math.cos(turn))).forEach((turn, i) => {  // closely about the device's resonances, over which H all but vanishes
    for (let far = Math.max(-re[i], SMALLEST); turn > 0 && far < Math.PI / turns; far *= 2) angles.add(turn - far), angles.add(turn), angles.add(turn + far);
  });
  const at = (theta) => {
    const v = new Float64Array(8);
    onCircle(loop, theta, v);
    return { theta, v, event: -1 };
  };
  const sorted = [...angles].filter((theta) => theta >= SMALLEST && theta <= Math.PI - SMALLEST).sort((a, b) => a - b).map(at);
  /** @type {{theta: number, v: Float64Array, event: number}[]} */
  const result = [sorted[0]];
  const bends = (p, q, h) => {
    for (const i of [0, 4]) {
      const far = Math.abs(q[i] - p[i] - h * (p[i + 2] + q[i + 2]) / 2) + Math.abs(q[i + 1] - p[i + 1] - h * (p[i + 3] + q[i + 3]) / 2);
      if (far > BENT * (Math.abs(p[i]) + Math.abs(p[i + 1]) + Math.abs(q[i]) + Math.abs(q[i + 1]))) return true;
    }
    return false;
  };
  /** @type {(p: any, q: any, depth: number) => void} */
  const fill = (p, q, depth) => {
    if (depth < 24 && bends(p.v, q.v, q.theta - p.theta)) {
      const middle = at((p.theta + q.theta) / 2);
      fill(p, middle, depth + 1), fill(middle, q, depth + 1);
      return;
    }
    const inner = [];
    EVENTS.forEach((event, e) => { if ((event(p.v) > 0) !== (event(q.v) > 0)) inner.push(zero(loop, event, p, q, e)); });
    result.push(...inner.sort((a, b) => a.theta - b.theta), q);
  };
  for (let i = 1; i < sorted.length; i++) fill(sorted[i - 1], sorted[i], 0);
  return result;
}

/**
 * Return the node between two others at which a function of their values is 0 (false position, Illinois).
 * @param {Sampled} loop @param {(v: Float64Array) => number} of @param {any} p @param {any} q @param {number} event
 */
function zero(loop, of, p, q, event) {
  let low = p.theta, high = q.theta, atLow = of(p.v), atHigh = of(q.v), theta = low, side = 0;
  const v = new Float64Array(8);
  for (let step = 0; step < 60; step++) {
    const next = step < 40 ? (low * atHigh - high * atLow) / (atHigh - atLow) : (low + high) / 2;
    if (Math.abs(next - theta) <= 1e-14 * high) break;
    theta = next > low && next < high ? next : (low + high) / 2;
    onCircle(loop, theta, v);
    const there = of(v);
    if (there === 0) break;
    if ((there > 0) === (atLow > 0)) {
      low = theta, atLow = there;
      if (side === 1) atHigh /= 2;
      side = 1;
    } else {
      high = theta, atHigh = there;
      if (side === -1) atLow /= 2;
      side = -1;
    }
  }
  onCircle(loop, theta, v);
  return { theta, v, event };
}

/**
 * Return the branches of a loop, cut into cells along which alpha and beta are monotone, and lines of real N and H.
 * @param {Sampled} loop @returns {Curve}
 */
function curve(loop) {
  if (loop.curve) return loop.curve;
  // where N is 0 beta is infinite; all other events meet there
  const found = nodes(loop).filter(({ v, event }) => event < 1 || Math.hypot(v[4], v[5]) > 1e-12), v = new Float64Array(8);
  /** @type {Line[]} */ const lines = [];
  /** @type {Cell[]} */ const cells = [];
  const soft = [], turning = [];
  const free = (node) => node.event === 0 && Math.abs(node.v[1]) < 1e-9 * Math.abs(node.v[0]);
  for (const { v: w, event, theta } of found) {
    if (free({ v: w, event })) lines.push({ value: w[0], slope: w[4], bend: w[3], bendSlope: w[7], turn: 2 });
    else if (event > 0) turning.push(w[1] / w[5]);
    // poles on the circle at alpha = 0 move outwards as beta rises where Im(N conj(dF/dtheta)) > 0, F = alpha + beta N - H
    const beta = w[1] / w[5], outwards = w[5] * (beta * w[6] - w[2]) - w[4] * (beta * w[7] - w[3]);
    if (event === 3) soft.push([beta, outwards > 0 ? 2 : -2]);
  }
  onCircle(loop, Math.PI, v);
  lines.push({ value: v[0], slope: v[4], bend: v[3], bendSlope: v[7], turn: 1 });
  for (const { value, slope, bend, bendSlope, turn } of lines) {
    const beta = value / slope;
    if (slope) soft.push([beta, slope * (bend - beta * bendSlope) > 0 ? turn : -turn]), turning.push(beta);
  }
  const point = (node, next) => {
    const w = node.v, rate = node.event === 0 ? (next.v[5] > 0 ? 1e-300 : -1e-300) : w[5];
    const beta = free(node) ? w[3] / w[7] : w[1] / rate;
    // where N is 0, as of a window of 4 samples at z = j, alpha stays finite while beta does not
    return [beta, node.event === 3 ? 0 : w[0] - (Math.abs(w[4]) > (node.event === 0 ? 1e-12 : 0) ? beta * w[4] : 0)];
  };
  for (let i = 1; i < found.length; i++) {
    const p = found[i - 1], q = found[i], [b0, a0] = point(p, q), [b1, a1] = point(q, p), rate = p.event === 0 ? q.v[5] : p.v[5];
    cells.push({ t0: p.theta, t1: q.theta, b0, b1, a0, a1, turn: (b1 > b0) === (rate > 0) ? 2 : -2, edge: false });
  }
  // at both ends alpha and beta are even functions of the angle
  const outer = (theta, twice, next, last) => {
    onCircle(loop, twice, v);
    const far = [v[1] / v[5], v[0] - v[1] / v[5] * v[4]], near = last ? [next.b1, next.a1] : [next.b0, next.a0];
    const [beta, alpha] = near.map((value, i) => value + (value - far[i]) / 3);
    const [b0, b1] = last ? [near[0], beta] : [beta, near[0]], [a0, a1] = last ? [near[1], alpha] : [alpha, near[1]];
    onCircle(loop, theta, v);
    return { t0: theta, t1: theta, b0, b1, a0, a1, turn: (b1 > b0) === (v[5] > 0) ? 2 : -2, edge: true };
  };
  const first = outer(SMALLEST, 2 * SMALLEST, cells[0], false);
  if (!loop.gamma) first.a0 = 0, soft.push([first.b0, -2]);
  turning.push(first.b0);
  const end = outer(Math.PI - SMALLEST, Math.PI - 2 * SMALLEST, cells[cells.length - 1], true);
  if (Number.isFinite(end.b1)) turning.push(end.b1);
  cells.unshift(first), cells.push(end);
  const all = cells.filter((cell) => Math.max(cell.a0, cell.a1) > 0 && cell.b0 !== cell.b1);
  loop.curve = { cells: all, lines, soft, turning: distinct(turning), nodes: found };
  return loop.curve;
}

/** @param {number[]} values @returns {number[]} finite ones in order, each once */
function distinct(values) {
  const sorted = values.filter(Number.isFinite).sort((a, b) => a - b);
  return sorted.filter((value, i) => !i || value - sorted[i - 1] > 1e-12 * Math.max(Math.abs(value), Math.abs(sorted[i - 1])));
}

const scratch = new Float64Array(8);

/**
 * Return alpha at which a cell is met by a damping.
 * @param {Sampled} loop @param {Cell} cell @param {number} beta @returns {number}
 */
function crossing(loop, cell, beta) {
  const share = (beta - cell.b0) / (cell.b1 - cell.b0);
  const least = Math.min(cell.a0, cell.a1) >= 0 ? Number.MIN_VALUE : -Infinity;  // rounding leaves no cell
  if (cell.edge) return cell.a0 + share * (cell.a1 - cell.a0);
  let low = cell.t0, high = cell.t1, theta = Number.isFinite(share) && Math.abs(cell.b1 - cell.b0) < 1e100 ? low + share * (high - low) : (low + high) / 2;
  const rises = cell.turn > 0, v = scratch;
  for (let step = 0; step < 80; step++) {
    onCircle(loop, theta, v);
    const miss = v[1] - beta * v[5], slope = v[3] - beta * v[7];
    if (miss === 0) break;
    if ((miss > 0) === rises) high = theta; else low = theta;
    const change = -miss / slope, next = theta + change;
    if (Math.abs(change) <= 1e-8 * theta && next >= cell.t0 && next <= cell.t1) return Math.max(least, v[0] - beta * v[4] + change * (v[2] - beta * v[6]));
    theta = next > low && next < high ? next : (low + high) / 2;
    if (high - low <= 1e-15 * high) break;
  }
  return Math.max(least, v[0] - beta * v[4]);
}

/**
 * Return the lowest alpha > 0 at which a pole pair lies on the circle, at a damping; infinity where there is none.
 * @param {Sampled} loop @param {Curve} known @param {number} beta @returns {number}
 */
function lowest(loop, known, beta) {
  let best = Infinity;
  for (const { value, slope } of known.lines) {
    const alpha = value - beta * slope;
    if (alpha > 0 && alpha < best) best = alpha;
  }
  for (const cell of known.cells) {
    if ((cell.b0 < beta) === (cell.b1 < beta) || Math.min(cell.a0, cell.a1) >= best) continue;
    const alpha = crossing(loop, cell, beta);
    if (alpha > 0 && alpha < best) best = alpha;
  }
  return best;
}

/**
 * Return the stable intervals of alpha > 0 beyond the one that begins at 0, at a damping.
 * @param {Sampled} loop @param {Curve} known @param {number} beta @param {number} unstable poles of a soft wall
 * @returns {number[][]}
 */
function beyond(loop, known, beta, unstable) {
  const met = known.lines.map(({ value, slope, bend, bendSlope, turn }) => [value - beta * slope, bend - beta * bendSlope > 0 ? turn : -turn]);
  const cells = known.cells.filter((cell) => (cell.b0 < beta) !== (cell.b1 < beta));
  if (!cells.some((cell) => cell.turn < 0) && !met.some(([, turn]) => turn < 0)) return [];
  for (const cell of cells) met.push([crossing(loop, cell, beta), cell.turn]);
  const result = [], rest = met.filter(([alpha]) => alpha > 0).sort((p, q) => p[0] - q[0]);
  let count = unstable;
  for (let i = 0; i + 1 < rest.length; i++) {
    count += rest[i][1];
    if (count === 0 && rest[i + 1][0] > rest[i][0] * (1 + 1e-9)) result.push([rest[i][0], rest[i + 1][0]]);
  }
  return result;
}

/** @param {Sampled} loop @param {number} alpha @param {number} beta @returns {number} number of poles outside the circle */
function unstablePoles(loop, alpha, beta) {
  const [re, im] = normalisedPoles(loop, alpha, beta);
  return re.filter((value, i) => Math.hypot(value, im[i]) >= 1).length;
}

/** Share of the way to the next level by which the first lies beside the end of a part, where the limit is 0. */
const NEXT_TO_END = 1e-2;
/** Samples of delay and filter beyond which eigenvalues take long. */
const LONG = 24;
/** Dampings between two turns at which islands are drawn, and places between them at which they are looked for. */
const ISLAND_LEVELS = 16, ISLAND_PLACES = [0.02, 0.1, 0.22, 0.36, 0.5, 0.64, 0.78, 0.9, 0.98];

/**
 * Return the limit of walls over damping, islands beside it, and the largest stable stiffness, in SI.
 *
 * The limit at a damping is the largest stiffness up to which every softer wall is stable. NaN lies between separate
 * parts. `islands` are stable intervals beyond it: the same as of `pipeline theory boundary --device`.
 * @param {DeviceFile | Sampled} file @param {number} [points] about how many, at least 8
 */
export function boundary(file, points = 400) {
  const loop = prepare(file), known = curve(loop), { soft, turning } = known;
  const count = number("points", points, 8), K = loop.units.stiffness, B = loop.units.damping;
  // beyond the outermost soft walls are islands alone
  const ends = distinct([...soft.map(([beta]) => beta), turning[0] - 1, turning[turning.length - 1] + 1]);
  const segments = ends.slice(1).map((high, i) => {
    const low = ends[i], edges = [low, ...turning.filter((beta) => beta > low && beta < high), high];
    const middles = edges.slice(1).map((beta, k) => (beta + edges[k]) / 2);
    return { low, high, edges, unstable: 0, beta: middles.reduce((best, other) => Math.abs(other) < Math.abs(best) ? other : best) };
  });
  // the unstable poles of soft walls: by eigenvalues, of long delays and filters only where crossings leave none
  const gained = (/** @type {number} */ at) => soft.reduce((sum, [beta, turn]) => Math.abs(beta - at) <= 1e-12 * Math.abs(at) ? sum + turn : sum, 0);
  const set = (/** @type {any} */ segment, counted = 0) => {
    segment.unstable = counted;
    if (counted > 0 && loop.whole + loop.filter.order > LONG) return;
    const top = lowest(loop, known, segment.beta);
    segment.unstable = unstablePoles(loop, Number.isFinite(top) ? top / 2 : 1, segment.beta);
  };
  const first = segments.reduce((best, { beta }, i) => Math.abs(beta) < Math.abs(segments[best].beta) ? i : best, 0);
  set(segments[first]);
  for (let i = first + 1; i < segments.length; i++) set(segments[i], segments[i - 1].unstable + gained(segments[i].low));
  for (let i = first - 1; i >= 0; i--) set(segments[i], segments[i + 1].unstable - gained(segments[i].high));
  const parts = [], stiffness = [], damping = [], islands = [];
  for (const { low, high, unstable } of segments) {
    const last = parts[parts.length - 1];
    if (!unstable && last && last[1] === low) last[1] = high;
    else if (!unstable) parts.push([low, high]);
  }
  const width = parts.reduce((total, [low, high]) => total + high - low, 0);
  let peak = -Infinity, at = NaN;
  for (const [low, high] of parts) {
    const levels = [], n = Math.max(8, Math.round(count * (high - low) / width));
    for (let i = 0; i <= n; i++) levels.push(low + (high - low) * 0.5 * (1 - Math.cos(Math.PI * i / n)));
    levels[0] = low + NEXT_TO_END * (levels[1] - low), levels[n] = high - NEXT_TO_END * (high - levels[n - 1]);
    for (const beta of turning) {
      const offset = 1e-11 * (high - low);
      if (beta - offset > levels[0] && beta + offset < levels[n]) levels.push(beta - offset, beta + offset);
    }
    levels.sort((a, b) => a - b);
    const limit = levels.map((beta) => lowest(loop, known, beta));
    const [top, where] = highest(loop, known, levels, limit, [low, high]);
    if (top > peak) peak = top, at = where;
    // where a branch turns back beside the stiffest level, the limit rises as a root up to the turn itself
    for (const { v, event } of known.nodes) {
      const beta = v[1] / v[5], alpha = v[0] - beta * v[4];
      if (event === 1 && Math.abs(beta - at) < 2e-11 * (high - low) && alpha > peak && alpha < peak * (1 + 1e-3)) peak = alpha, at = beta;
    }
    if (stiffness.length) stiffness.push(NaN), damping.push(NaN);
    levels.forEach((beta, i) => {
      if (Number.isFinite(limit[i])) stiffness.push(limit[i] * K), damping.push(beta * B);
    });
  }
  // evenly where dampings are of the usual size: far out an island beside the end of a gap would not be met
  const sizes = [...turning, 1].map(Math.abs).sort((a, b) => a - b), usual = sizes[sizes.length >> 1] || 1;
  for (const { edges, unstable } of known.cells.some((cell) => cell.turn < 0) ? segments : []) {
    for (let i = 0; i + 1 < edges.length; i++) {
      const from = Math.asinh(edges[i] / usual), way = Math.asinh(edges[i + 1] / usual) - from;
      const at = (share) => usual * Math.sinh(from + way * 0.5 * (1 - Math.cos(Math.PI * share)));
      const share = ISLAND_PLACES.find((place) => beyond(loop, known, at(place), unstable).length);
      if (share === undefined) continue;
      const [[low, high]] = beyond(loop, known, at(share), unstable);
      if (unstablePoles(loop, (low + high) / 2, at(share))) continue;
      for (let j = 0; j < ISLAND_LEVELS; j++) {
        const beta = at((j + 0.5) / ISLAND_LEVELS);
        for (const [from, to] of beyond(loop, known, beta, unstable)) islands.push({ damping: beta * B, stiffness_low: from * K, stiffness_high: to * K });
      }
    }
  }
  const found = peak > -Infinity;
  return { stiffness, damping, stiffness_max: found ? peak * K : NaN, damping_at_stiffness_max: at * B, islands };
}

/**
 * Return where a function with one peak is largest, by golden sections.
 * @param {(x: number) => number} of @param {number} low @param {number} high @param {number} [steps] @returns {number}
 */
function golden(of, low, high, steps = 45) {
  const share = 0.6180339887498949;
  let p = high - share * (high - low), q = low + share * (high - low), atP = of(p), atQ = of(q);
  for (let step = 0; step < steps; step++) {
    if (atP > atQ) high = q, q = p, atQ = atP, p = high - share * (high - low), atP = of(p);
    else low = p, p = q, atP = atQ, q = low + share * (high - low), atQ = of(q);
  }
  return atP > atQ ? p : q;
}

/**
 * Return the largest limit between levels, and its damping: at a turn of a branch, or where two of them meet.
 * @param {Sampled} loop @param {Curve} known @param {number[]} levels @param {number[]} limit @param {number[]} part
 * @returns {[number, number]}
 */
function highest(loop, known, levels, limit, [low, high]) {
  let best = -Infinity, at = NaN;
  const try_ = (beta, alpha = lowest(loop, known, beta)) => {
    if (alpha > best && alpha < Infinity) best = alpha, at = beta;
    return alpha;
  };
  levels.forEach((beta, i) => try_(beta, limit[i]));
  for (const share of [1e-12, 1 - 1e-12]) try_(low + share * (high - low));  // where soft walls become unstable it may be largest
  const peaks = [];
  for (let i = 1; i + 1 < levels.length; i++) if (limit[i] >= limit[i - 1] && limit[i] >= limit[i + 1]) peaks.push(i);
  for (const i of peaks.sort((p, q) => limit[q] - limit[p]).slice(0, 2)) {
    if (levels[i + 1] - levels[i - 1] > 1e-8 * Math.abs(levels[i])) golden(try_, levels[i - 1], levels[i + 1]);
  }
  return [best, at];
}

// ---------------------------------------------------------------------------------------------------------- poles

/**
 * Return the eigenvalues of a real matrix, by balancing, Hessenberg form and the QR algorithm (EISPACK, hqr).
 * @param {Float64Array} matrix @param {number} n @returns {[Float64Array, Float64Array]} real and imaginary parts
 */
export function eigenvalues(matrix, n) {
  const H = matrix.slice(), re = new Float64Array(n), im = new Float64Array(n);
  balance(H, n);
  for (let m = 1; m < n - 1; m++) {  // elimination with pivots
    let pivot = 0, row = m;
    for (let i = m; i < n; i++) if (Math.abs(H[i * n + m - 1]) > Math.abs(pivot)) pivot = H[i * n + m - 1], row = i;
    if (row !== m) {
      for (let j = m - 1; j < n; j++) [H[row * n + j], H[m * n + j]] = [H[m * n + j], H[row * n + j]];
      for (let j = 0; j < n; j++) [H[j * n + row], H[j * n + m]] = [H[j * n + m], H[j * n + row]];
    }
    if (!pivot) continue;
    for (let i = m + 1; i < n; i++) {
      const factor = H[i * n + m - 1] / pivot;
      if (!factor) continue;
      H[i * n + m - 1] = 0;
      for (let j = m; j < n; j++) H[i * n + j] -= factor * H[m * n + j];
      for (let j = 0; j < n; j++) H[j * n + m] += factor * H[j * n + i];
    }
  }
  let norm = 0;
  for (let i = 0; i < n * n; i++) norm += Math.abs(H[i]);
  let end = n - 1, shift = 0, tries = 0;
  while (end >= 0) {
    let l = end;
    for (; l > 0; l--) {
      const size = Math.abs(H[(l - 1) * n + l - 1]) + Math.abs(H[l * n + l]) || norm;
      if (Math.abs(H[l * n + l - 1]) <= Number.EPSILON * size) {
        H[l * n + l - 1] = 0;
        break;
      }
    }
    let x = H[end * n + end];
    if (l === end) {
      re[end] = x + shift, im[end] = 0, end--, tries = 0;
      continue;
    }
    let y = H[(end - 1) * n + end - 1], w = H[end * n + end - 1] * H[(end - 1) * n + end];
    if (l === end - 1) {
      const p = 0.5 * (y - x), q = p * p + w, z = Math.sqrt(Math.abs(q));
      x += shift;
      if (q >= 0) {
        const far = p + (p >= 0 ? z : -z);
        re[end - 1] = x + far, re[end] = far ? x - w / far : x + far;
      } else {
        re[end - 1] = re[end] = x + p, im[end - 1] = z, im[end] = -z;
      }
      end -= 2, tries = 0;
      continue;
    }
    if (tries === 200) throw new Error("the poles of this wall were not found");
    if (tries % 10 === 9) {  // another shift where it goes round in circles
      shift += x;
      for (let i = 0; i <= end; i++) H[i * n + i] -= x;
      const s = Math.abs(H[end * n + end - 1]) + Math.abs(H[(end - 1) * n + end - 2]);
      x = y = 0.75 * s, w = -0.4375 * s * s;
    }
    tries++;
    let m = end - 2, p = 0, q = 0, r = 0;
    for (; m >= l; m--) {
      const z = H[m * n + m], a = x - z, b = y - z;
      p = (a * b - w) / H[(m + 1) * n + m] + H[m * n + m + 1];
      q = H[(m + 1) * n + m + 1] - z - a - b, r = H[(m + 2) * n + m + 1];
      const s = Math.abs(p) + Math.abs(q) + Math.abs(r);
      p /= s, q /= s, r /= s;
      if (m === l) break;
      const u = Math.abs(H[m * n + m - 1]) * (Math.abs(q) + Math.abs(r));
      const v = Math.abs(p) * (Math.abs(H[(m - 1) * n + m - 1]) + Math.abs(z) + Math.abs(H[(m + 1) * n + m + 1]));
      if (u <= Number.EPSILON * v) break;
    }
    for (let k = m; k < end; k++) {
      const three = k !== end - 1;
      if (k !== m) {
        p = H[k * n + k - 1], q = H[(k + 1) * n + k - 1], r = three ? H[(k + 2) * n + k - 1] : 0;
        x = Math.abs(p) + Math.abs(q) + Math.abs(r);
        if (!x) continue;
        p /= x, q /= x, r /= x;
      }
      const s = Math.sqrt(p * p + q * q + r * r) * (p < 0 ? -1 : 1);
      if (!s) continue;
      if (k !== m) {
        H[k * n + k - 1] = -s * x, H[(k + 1) * n + k - 1] = 0;
        if (three) H[(k + 2) * n + k - 1] = 0;
      } else if (l !== m) H[k * n + k - 1] = -H[k * n + k - 1];
      p += s, x = p / s, y = q / s, q /= p, r /= p;
      const z = r * p / s;
      for (let j = k; j <= end; j++) {
        const t = H[k * n + j] + q * H[(k + 1) * n + j] + (three ? r * H[(k + 2) * n + j] : 0);
        H[k * n + j] -= t * x, H[(k + 1) * n + j] -= t * y;
        if (three) H[(k + 2) * n + j] -= t * z;
      }
      for (let i = l; i <= Math.min(end, k + 3); i++) {
        const t = x * H[i * n + k] + y * H[i * n + k + 1] + (three ? z * H[i * n + k + 2] : 0);
        H[i * n + k] -= t, H[i * n + k + 1] -= t * q;
        if (three) H[i * n + k + 2] -= t * r;
      }
    }
  }
  return [re, im];
}

/**
 * Return the motion of device and wall by samples (3.18), and the step's state at its first sample as deviation from the
 * final position over the displacement. A state has the device's, its last position, the filter's, and the delayed
 * forces, newest first. `move` replaces a state by the next and sets what acted: `g`, the device's state and forces,
 * `place`, the distance `way` from the last position, and `force`, the new command.
 * @param {Sampled} loop @param {number} alpha @param {number} beta
 */
function motion(loop, alpha, beta) {
  const { n, q, C, step, filter: f, whole } = loop, own = n + 1 + f.order, size = own + whole + (loop.topOld ? 1 : 0);
  const start = new Float64Array(size).fill(alpha, own), moved = new Float64Array(f.order);
  start[0] = start[n] = -1;
  if (loop.mechanical < n) start[n - 1] = -loop.gamma;
  const wall = { size, start, g: new Float64Array(q), place: 0, way: 0, force: 0, move: (/** @type {Float64Array} */ x) => {
    let place = 0;
    for (let i = 0; i < n; i++) place += C[i] * x[i], wall.g[i] = x[i];
    const way = place - x[n];
    let velocity = f.direct * way;
    for (let i = 0; i < f.order; i++) {
      velocity += f.row[i] * x[n + 1 + i], moved[i] = f.gain[i] * way;
      for (let j = 0; j < f.order; j++) moved[i] += f.step[i * f.order + j] * x[n + 1 + j];
    }
    wall.place = place, wall.way = way, wall.force = -(alpha * place + beta * velocity);
    if (loop.topOld) wall.g[n] = x[own + whole];
    wall.g[q - 1] = whole ? x[own + whole - 1] : wall.force;
    for (let i = 0; i < n; i++) x[i] = along(step, i, wall.g);
    x[n] = place, x.set(moved, n + 1);
    if (size > own) x.copyWithin(own + 1, own, size - 1), x[own] = wall.force;
  } };
  return wall;
}

/** @param {Sampled} loop @param {number} alpha @param {number} beta @returns {[Float64Array, Float64Array]} poles of a wall */
function normalisedPoles(loop, alpha, beta) {
  const { size: n, move } = motion(loop, alpha, beta), M = new Float64Array(n * n);
  for (let j = 0; j < n; j++) {
    const x = new Float64Array(n);
    x[j] = 1, move(x);
    for (let i = 0; i < n; i++) M[i * n + j] = x[i];
  }
  return eigenvalues(M, n);
}

/**
 * Return the poles of a wall in SI, real and imaginary parts in pairs.
 * @param {DeviceFile | Sampled} file @param {number} stiffness @param {number} damping @returns {[number, number][]}
 */
export function poles(file, stiffness, damping) {
  const loop = prepare(file), [re, im] = normalisedPoles(loop, stiffness / loop.units.stiffness, damping / loop.units.damping);
  return Array.from(re, (value, i) => [value, im[i]]);
}

// ------------------------------------------------------------------------------------------------------ passivity

/** Angles of a turn of the delayed force, angle times delay and lag below which digits are lost, and smallest angle. */
const PASSIVE_PER_TURN = 40, NEAR_ZERO = 8e-3, SLOWEST = 1e-6, DIRECTIONS = 181;

/**
 * Set the coefficients of what a wall needs of the device's damping at an angle:
 * [Re(y S1)] of alpha and beta, then (S0 S2 - |S1|^2) |y|^2 of alpha^2, alpha beta and beta^2.
 * @param {Sampled} loop @param {number} angle @param {Float64Array} out @param {number} at
 */
function needs(loop, angle, out, at) {
  const first = Math.ceil(loop.delay), share = first - loop.delay, lag = loop.lag, v = scratch;
  const ur = Math.cos(angle), ui = -Math.sin(angle), half = Math.sin(angle / 2), xr = 2 * half * half, xi = -ui;  // 1 - u
  const s0 = 0.25 / (half * half), ir = 0.5, ii = -xi / (xr * xr + xi * xi);  // 1/(1 - u)
  let rr = ur * (ir * ir - ii * ii) - ui * 2 * ir * ii, ri = ui * (ir * ir - ii * ii) + ur * 2 * ir * ii, s2 = s0;
  rr += (share - lag) * ir, ri += (share - lag) * ii;
  if (lag) {
    const e = Math.exp(-1 / lag), dr = 1 - e * ur, di = -e * ui, size = dr * dr + di * di, part = lag * Math.exp(-share / lag);
    rr += part * dr / size, ri -= part * di / size;
    s2 = s0 - lag * dr / size + lag / 2;
  }
  const cr = Math.cos(first * angle), ci = -Math.sin(first * angle);
  const s1r = -(cr * rr - ci * ri), s1i = -(cr * ri + ci * rr), base = NEAR_ZERO / (loop.delay + lag + 1);
  let rest = Math.max(s0 * s2 - s1r * s1r - s1i * s1i, 0);  // grows as 1/angle^2
  if (angle < base) needs(loop, base, out, at), rest = out[at + 2] * (base / angle / (2 * Math.sin(base / 2))) ** 2;
  loop.filter.value(angle, v);
  const qr = xr * v[4] - xi * v[5], qi = xr * v[5] + xi * v[4];
  out[at] = xr * s1r - xi * s1i, out[at + 1] = qr * s1r - qi * s1i;
  out[at + 2] = (xr * xr + xi * xi) * rest, out[at + 3] = 2 * (xr * qr + xi * qi) * rest, out[at + 4] = (qr * qr + qi * qi) * rest;
}

/** @param {Float64Array} c @param {number} i @param {number} a @param {number} b @returns {number} */
function needed(c, i, a, b) {
  const line = a * c[i] + b * c[i + 1], square = a * a * c[i + 2] + a * b * c[i + 3] + b * b * c[i + 4];
  return 0.5 * (line + Math.sqrt(line * line + Math.max(square, 0)));
}

/**
 * Return a function that gives the damping that walls need of the device's near side, and the table that it reads.
 * @param {Sampled} loop @returns {(alpha: number, beta: number) => number}
 */
function requirement(loop) {
  const turns = PASSIVE_PER_TURN * (loop.whole + (loop.topOld ? 3 : 2)), angles = [];
  for (let t = SLOWEST; t < Math.PI; t += Math.min((t < 1e-3 ? 1 : 0.25) * t, Math.PI / turns)) angles.push(t);
  angles.push(Math.PI);
  const count = angles.length, table = new Float64Array(5 * count), c = new Float64Array(10), heights = new Float64Array(count);
  angles.forEach((angle, i) => needs(loop, angle, table, 5 * i));
  return (a, b) => {
    const at = (angle) => (needs(loop, Math.min(Math.PI, Math.max(SLOWEST, angle)), c, 0), needed(c, 0, a, b));
    let best = 0;
    for (let i = 0; i < count; i++) best = Math.max(best, heights[i] = needed(table, 5 * i, a, b));
    for (let i = 1, most = best; i + 1 < count; i++) {
      if (heights[i] >= Math.max(heights[i - 1], heights[i + 1], 0.8 * most)) best = Math.max(best, at(golden(at, angles[i - 1], angles[i + 1], 20)));
    }
    return Math.max(best, (4 * heights[0] - heights[1]) / 3);  // an even function of the angle, at the smallest and twice it
  };
}

/**
 * Return the outline of the passive walls in SI, closed, and the stiffest of them. All are 0 where the device has no
 * damping; none exist where the position is sensed beyond a mode, or where logs prove none (`reason`).
 * @param {DeviceFile | Sampled} file @param {number} [directions] from B < 0 to B > 0 in which walls are looked for
 * @param {string} [unproven] why logs of this loop prove no wall to be passive
 */
export function passive(file, directions = DIRECTIONS, unproven = "") {
  const loop = prepare(file), { stiffness: K, damping: B } = loop.units;
  const reason = unproven ? `not proven: ${unproven}` : loop.atLoad ? "the position is sensed beyond the vibration mode: no wall is passive for every hand" : "";
  if (reason) return { stiffness: [], damping: [], stiffness_max: null, damping_at_stiffness_max: null, reason };
  const needs = requirement(loop), lever = loop.delay + loop.lag + 0.5;
  const reached = (angle) => {
    const alpha = Math.cos(angle) / lever, beta = Math.sin(angle), reach = loop.near / needs(alpha, beta);
    return [alpha * reach, beta * reach];
  };
  const stiffness = [], damping = [];
  for (let i = 0; i < directions; i++) {
    const [alpha, beta] = reached(Math.PI * (i / (directions - 1) - 0.5));
    stiffness.push(alpha * K), damping.push(beta * B);
  }
  stiffness.push(stiffness[0]), damping.push(damping[0]);
  let top = stiffness.indexOf(Math.max(...stiffness)), best = [0, 0];
  if (loop.near > 0) {
    const width = Math.PI / (directions - 1), low = (top - 1) * width - Math.PI / 2;
    best = reached(golden((angle) => reached(angle)[0], low, low + 2 * width));
  }
  return { stiffness, damping, stiffness_max: best[0] * K, damping_at_stiffness_max: best[1] * B };
}

// ------------------------------------------------------------------------------------------------------ responses

/** Degree of the series of a motion over a piece of a sampling interval, about the middle of the piece. */
const DEGREE = 16;
/** Integrals over [-1, 1] of the products of two powers up to that degree and x^0, x^1 or x^2. */
const INTEGRALS = [0, 1, 2].map((power) => Float64Array.from({ length: (DEGREE + 1) ** 2 }, (_, at) => {
  const whole = Math.floor(at / (DEGREE + 1)) + at % (DEGREE + 1) + power;
  return whole % 2 ? 0 : 2 / (whole + 1);
}));

/**
 * Return the pieces of a sampling interval: rows that take the device's state at its start and the forces that act,
 * the older before the newer, to the series of the position over the piece, and to position and velocity at its end.
 * @param {Sampled} loop
 */
function pieces(loop) {
  if (loop.pieces) return loop.pieces;
  const { n, q, A, B, C } = loop, w = n + 1, [re, im] = eigenvalues(A, n), M = augmented(A, B, n), parts = [], terms = DEGREE + 1;
  const rows = new Float64Array(terms * w);  // of the position's derivatives over k!
  rows.set(C);
  for (let k = 1; k <= DEGREE; k++) rows.set(product(rows.subarray(k * w - w, k * w), M, 1, w, w).map((value) => value / k), k * w);
  let turning = 0, settling = 0;
  for (let i = 0; i < n; i++) {
    if (Math.abs(im[i]) > Math.abs(re[i])) turning = Math.max(turning, Math.hypot(re[i], im[i]));
    else settling = Math.max(settling, Math.abs(re[i]));
  }
  // state of the device at the start of a segment, of the state and the forces at the start of the sample
  let given = new Float64Array(n * q), offset = 0;
  for (let i = 0; i < n; i++) given[i * q + i] = 1;
  const form = Array.from({ length: 6 }, () => new Float64Array(q * q));  // e^2 and v^2 times tau^0, tau^1, tau^2
  const over = (time) => {
    const E = exponential(M.map((value) => value * time), w);
    return E.map((value, i) => value + (i % (w + 1) ? 0 : 1));
  };
  for (const [duration, column] of loop.topOld ? [[loop.fraction, n], [1 - loop.fraction, n + 1]] : [[1, n]]) {
    const start = new Float64Array(w * q);
    start.set(given), start[n * q + column] = 1;
    const halvings = settling > 0 ? Math.max(0, Math.ceil(Math.log2(settling * duration))) : 0;
    for (let h = halvings; h >= 0; h--) {
      const from = h === halvings ? 0 : duration / 2 ** (h + 1), to = duration / 2 ** h, fine = Math.max(1, Math.ceil(turning * (to - from)));
      for (let i = 0; i < fine; i++) {
        const length = (to - from) / fine, begin = from + i * length, about = product(over(begin + length / 2), start, w, w, q);
        const series = product(rows, about, terms, w, q).map((value, at) => value * (length / 2) ** Math.floor(at / q));
        const ends = new Float64Array(2 * q), half = length / 2, middle = offset + begin + half;
        const speeds = series.map((_, at) => (Math.floor(at / q) + 1) * (series[at + q] ?? 0) / half);
        for (let at = 0; at < terms * q; at++) ends[at % q] += series[at], ends[q + at % q] += speeds[at];
        [series, speeds].forEach((rows, kind) => {
          const turned = rows.map((_, at) => rows[at % terms * q + Math.floor(at / terms)]);
          const [one, x, square] = INTEGRALS.map((weights) => product(turned, product(weights, rows, terms, terms, q), q, terms, q));
          one.forEach((value, at) => {  // times tau^p, tau = middle + half x
            form[3 * kind][at] += half * value, form[3 * kind + 1][at] += half * (middle * value + half * x[at]);
            form[3 * kind + 2][at] += half * (middle * middle * value + half * (2 * middle * x[at] + half * square[at]));
          });
        });
        parts.push({ start: offset + begin, length, series, ends });
      }
    }
    given = product(over(duration), start, n, w, q), offset += duration;
  }
  loop.pieces = { parts, form };
  return loop.pieces;
}

/** @param {Float64Array} rows @param {number} row @param {Float64Array} g @returns {number} a row times a vector */
function along(rows, row, g) {
  let total = 0;
  for (let j = 0, at = row * g.length; j < g.length; j++) total += rows[at + j] * g[j];
  return total;
}

/** @param {Float64Array} curve @param {number} x @returns {[number, number, number]} value and two derivatives */
function motionAt(curve, x) {
  let value = 0, slope = 0, bend = 0;
  for (let k = DEGREE; k >= 0; k--) bend = bend * x + 2 * slope, slope = slope * x + value, value = value * x + curve[k];
  return [value, slope, bend];
}

/**
 * Return the place in [low, high] at which a function with a change of sign is 0, by Newton's method or halving.
 * @param {(x: number) => [number, number]} of value and slope @param {number} low @param {number} high
 */
function rootOf(of, low, high) {
  const rises = of(high)[0] > 0;
  let x = (low + high) / 2;
  for (let step = 0; step < 60; step++) {
    const [value, slope] = of(x);
    if ((value > 0) === rises) high = x; else low = x;
    const next = slope ? x - value / slope : NaN, best = next >= low && next <= high ? next : (low + high) / 2;
    if (Math.abs(best - x) <= 1e-14) return best;
    x = best;
  }
  return x;
}

/** @param {any} piece @param {Float64Array} g @returns {Float64Array} the series of the motion over a piece */
function series(piece, g) {
  const curve = new Float64Array(DEGREE + 1);
  for (let c = 0; c <= DEGREE; c++) curve[c] = along(piece.series, c, g);
  return curve;
}

/**
 * Return the slowest pole [size, angle], an angle in [0, pi], and the size of the slowest other one than its pair.
 * @param {Float64Array} re @param {Float64Array} im @param {Float64Array} sizes
 */
function leading(re, im, sizes) {
  const [first, ...rest] = [...sizes.keys()].sort((i, j) => sizes[j] - sizes[i] || im[j] - im[i]);
  const next = rest.find((i) => !im[first] || im[i] !== -im[first] || re[i] !== re[first]);
  return { size: sizes[first], angle: Math.atan2(Math.abs(im[first]), re[first]), next: next === undefined ? 0 : sizes[next] };
}

/** @param {number} re @param {number} im @returns {[number, number][]} sums of q^j, j q^j and j^2 q^j over j, of a q inside the circle */
function powers(re, im) {
  const times = (/** @type {number[]} */ [a, b], /** @type {number[]} */ [c, d]) => [a * c - b * d, a * d + b * c], size = (1 - re) ** 2 + im * im, D = [(1 - re) / size, im / size];
  const first = times(times([re, im], D), D);
  return /** @type {any} */ ([D, first, times(times(first, [1 + re, im]), D)]);
}

/**
 * Return the costs of a stable wall: settling times in samples, overshoots as fractions, energies without dimension.
 *
 * The response is followed until all motion is small, or until the slowest pole, with its pair, is all that moves. From
 * there on it is state = 2 Re(U lambda^j): energies are geometric sums, and the last entry into the band is looked for
 * in front of the end of the envelope.
 * @param {Sampled} loop @param {number} alpha @param {number} beta @param {{size: number, angle: number, next: number}} slowest
 * @param {number} longest @param {boolean} energies
 */
function stepCosts(loop, alpha, beta, slowest, longest, energies) {
  const { parts, form } = pieces(loop), { A, C, n, q } = loop, band = 0.02, stiffness = alpha + loop.gamma, sums = new Float64Array(6);
  const forms = [0, 1, 2].map((w) => form[w].map((value, k) => (value + form[3 + w][k] / stiffness) * (Math.floor(k / q) < k % q ? 2 : 1)));
  const rate = Float64Array.from({ length: n }, (_, j) => sum(n, (i) => C[i] * A[i * n + j]));
  const wall = motion(loop, alpha, beta), x = wall.start.slice(), own = n + 1 + loop.filter.order;
  const lever = Math.max(8 * (loop.delay + loop.lag + 1), 2 / Math.sqrt(stiffness)), scale = Math.abs(alpha) + loop.gamma + Math.abs(beta) / lever;
  const sizes = x.map((_, i) => i < loop.mechanical ? i % 2 ? lever : 1 : i === n ? 1 : i > n && i < own ? lever : 1 / scale);
  let k = 0, peak = 0, peakDiscrete = 0, outside = 0, entry = -1, settled = false, topped = false, summed = !energies, adding = energies;
  /** @type {(g: Float64Array, place: number, way: number) => number[]} energies of an interval by tau^0, tau^1, tau^2, and of a sample */
  const energy = (g, place, way) => [...forms.map((Q) => {
    let value = 0;
    for (let i = 0; i < q; i++) for (let j = i; j < q; j++) value += Q[i * q + j] * g[i] * g[j];
    return value;
  }), place * place + way * way / stiffness];
  /** @type {(E: (f: number, power: number) => number) => void} add energies times powers of the sample */
  const add = (E) => {
    sums[0] += E(0, 0), sums[1] += E(0, 1) + E(1, 0), sums[2] += E(0, 2) + 2 * E(1, 1) + E(2, 0);
    for (let w = 0; w < 3; w++) sums[3 + w] += E(3, w);
  };
  const sample = () => {
    wall.move(x);
    const { g, place, way } = wall;
    let here = place, speed = 0;
    if (place > peakDiscrete) peakDiscrete = place;
    if (Math.abs(place) > band) outside = Math.max(outside, k);
    for (let j = 0; j < n; j++) speed += rate[j] * g[j];
    for (const piece of parts) {
      const end = along(piece.ends, 0, g), after = along(piece.ends, 1, g), turns = (speed > 0) !== (after > 0);
      const enters = Math.abs(end) <= band, reach = turns ? piece.length * Math.min(Math.abs(speed), Math.abs(after)) : 0;
      let extreme = 0, turn = -1;
      if ((enters && Math.max(Math.abs(here), Math.abs(end)) + reach > band) || (turns && speed > 0 && Math.max(here, end) + reach > peak)) {
        const curve = series(piece, g);
        if (turns) {
          turn = rootOf((at) => { const [, slope, bend] = motionAt(curve, at); return [slope, bend]; }, -1, 1);
          extreme = motionAt(curve, turn)[0];
        }
        const swung = Math.abs(extreme) > band;
        if (enters && (swung || Math.abs(here) > band)) {
          const level = Math.sign(swung ? extreme : here) * band;
          const at = rootOf((at) => { const [value, slope] = motionAt(curve, at); return [value - level, slope]; }, swung ? turn : -1, 1);
          entry = Math.max(entry, k + piece.start + piece.length * (1 + at) / 2);
        }
      }
      peak = Math.max(peak, extreme, end), here = end, speed = after;
    }
    if (adding) {
      const E = energy(g, place, way);
      add((f, power) => E[f] * k ** power);
    }
    k++;
  };
  const slow = () => {
    const { size, angle, next } = slowest, pair = angle > 0 && angle < Math.PI;
    const turn = pair ? Math.max(1, Math.round(Math.PI / 2 / Math.min(angle, Math.PI - angle))) : 0, before = x.slice();
    if (k * Math.log(next / size) > GONE || turn > longest) return false;
    for (let i = 0; i < turn; i++) sample();
    const since = k, c = size ** turn * Math.cos(turn * angle), d = size ** turn * Math.sin(turn * angle);
    const U = [x.map((value) => value / 2), x.map((value, i) => pair ? (before[i] * d - c * (value - c * before[i]) / d) / 2 : 0)];
    const [R, I, both] = [...U, U[0].map((value, i) => value + U[1][i])].map((u) => (wall.move(u.slice()), { ...wall, g: wall.g.slice() }));
    if (adding) {
      const [aa, bb, ab] = [R, I, both].map(({ g, place, way }) => energy(g, place, way)), fades = powers(size * size, 0);
      const turns = powers(size * size * Math.cos(2 * angle), size * size * Math.sin(2 * angle));
      /** @type {(f: number, p: number) => number} */
      const of = (f, p) => 2 * ((aa[f] - bb[f]) * turns[p][0] - (ab[f] - aa[f] - bb[f]) * turns[p][1] + (aa[f] + bb[f]) * fades[p][0]);
      add((f, power) => power === 0 ? of(f, 0) : power === 1 ? since * of(f, 0) + of(f, 1) : since * since * of(f, 0) + 2 * since * of(f, 1) + of(f, 2));
      adding = false, summed = true;
    }
    // the size of the motion between samples, closely where it is largest
    const places = parts.flatMap((/** @type {any} */ piece) => {
      const [u, v] = [R, I].map(({ g }) => series(piece, g)), of = (/** @type {number} */ at) => 2 * Math.hypot(motionAt(u, at)[0], motionAt(v, at)[0]);
      return Array.from({ length: 33 }, (_, i) => ({ of, at: i / 16 - 1, size: of(i / 16 - 1), value: motionAt(u, i / 16 - 1)[0] }));
    }), near = Math.max(...places.map(({ size }) => size)), highest = Math.max(...places.map(({ value }) => value));
    const refined = places.filter(({ size }) => size > 0.999 * near).map(({ of, at }) => of(golden(of, Math.max(-1, at - 1 / 16), Math.min(1, at + 1 / 16))));
    const most = Math.max(near, ...refined) * (1 + 1e-12);
    topped ||= !angle && highest <= 0;  // it comes from below
    const sampled = 2 * Math.hypot(R.place, I.place), above = (/** @type {number} */ level, /** @type {number} */ top) => level * size ** (k - since) > Math.max(QUIET, top);
    while (!topped && k - since < longest) sample(), topped = !above(most, peak) && !above(sampled, peakDiscrete);
    settled = true;
    for (const [level, last] of /** @type {[number, () => number][]} */ ([[most, () => entry], [sampled, () => outside]])) {
      const end = level > band ? Math.ceil(Math.log(band / level) / Math.log(size)) + 1 : 0;
      for (let back = 64, first = end; first > 0; back *= 2) {
        if (back > longest) return settled = false, true;
        first = Math.max(0, end - back), k = since + first;
        const re = 2 * size ** first * Math.cos(first * angle), im = 2 * size ** first * Math.sin(first * angle);
        for (let i = 0; i < x.length; i++) x[i] = U[0][i] * re - U[1][i] * im;
        while (k < since + end) sample();
        if (last() >= since + first) break;
      }
    }
    return true;
  };
  for (let look = FIRST_LOOK; k < longest; ) {
    sample();
    if (k % 8) continue;
    let now = 0;
    for (let i = 0; i < x.length; i++) now = Math.max(now, Math.abs(x[i]) * sizes[i]);
    settled ||= now < 0.1 * band, topped ||= now < Math.max(QUIET, 0.1 * peak), summed ||= now < FADED;
    if (settled && topped && summed) break;
    if (k < look) continue;
    look *= 2;
    if (slow()) break;
  }
  const value = (x, known = settled) => known ? x : null;
  const names = ["w0", "w1", "w2"].flatMap((w, i) => [[`energy_step_${w}`, sums[i]], [`energy_step_${w}_discrete`, sums[3 + i]]]);
  return {
    settle_2pct: value(entry), overshoot: value(peak, topped), settle_2pct_discrete: value(outside + 1),
    overshoot_discrete: value(peakDiscrete, topped),
    ...(energies ? Object.fromEntries(names.map(([name, x]) => [name, value(/** @type {number} */ (x), summed)])) : {}),
  };
}

/**
 * Return stability and costs of walls in SI. Costs are null where a wall is unstable or still moves after `longest`
 * samples.
 * @param {DeviceFile | Sampled} file @param {ArrayLike<number>} stiffness @param {ArrayLike<number>} damping
 * @param {{longest?: number, energies?: boolean}} [options]
 */
export function walls(file, stiffness, damping, { longest = LONGEST, energies = true } = {}) {
  const loop = prepare(file);
  if (stiffness.length !== damping.length) throw new RangeError("stiffness, damping: expected as many of one as of the other");
  return Array.from(stiffness, (K, i) => {
    const alpha = number("stiffness", K, -Infinity) / loop.units.stiffness, beta = number("damping", damping[i], -Infinity) / loop.units.damping;
    const [re, im] = normalisedPoles(loop, alpha, beta), sizes = re.map((x, k) => Math.hypot(x, im[k])), radius = Math.max(...sizes);
    const stable = radius < 1 && alpha + loop.gamma > 0;
    const costs = stable && radius < 1 - MARGINAL ? stepCosts(loop, alpha, beta, leading(re, im, sizes), longest, energies) : { settle_2pct: null, overshoot: null };
    return { stable, spectral_radius: radius, ...costs };
  });
}

/**
 * Return the step response of a wall: position over the final one, and the command at each sample over the step.
 * Time is in seconds; at 0 the step reaches the actuator, with the wall's forces `delay_samples` behind.
 * @param {DeviceFile | Sampled} file @param {number} stiffness @param {number} damping @param {number} samples
 * @param {number} [perSample] points in each sampling interval
 */
export function response(file, stiffness, damping, samples, perSample = 8) {
  const loop = prepare(file), alpha = stiffness / loop.units.stiffness, beta = damping / loop.units.damping, T = loop.units.period;
  const { parts } = pieces(loop), time = [], position = [], command = [], wall = motion(loop, alpha, beta), x = wall.start;
  for (let k = 0; k <= samples; k++) {
    wall.move(x), command.push((wall.force + loop.gamma) / (alpha + loop.gamma));
    let i = 0;
    for (let j = 0; j < (k < samples ? perSample : 1); j++) {
      const tau = j / perSample;
      while (i + 1 < parts.length && tau >= parts[i + 1].start) i++;
      const at = motionAt(series(parts[i], wall.g), 2 * (tau - parts[i].start) / parts[i].length - 1)[0];
      time.push((k + tau) * T), position.push(1 + (j ? at : wall.place));
    }
  }
  return { time, position, command };
}

// -------------------------------------------------------------------------------------------------------- margins

/**
 * Return gain margins up and down, phase margin [rad], added delay [samples] and bandwidth [Hz] of a stable wall.
 * @param {DeviceFile | Sampled} file @param {number} stiffness @param {number} damping
 */
export function margins(file, stiffness, damping) {
  const loop = prepare(file), alpha = stiffness / loop.units.stiffness, beta = damping / loop.units.damping, v = new Float64Array(8);
  const wall = (w) => [alpha + beta * w[4], beta * w[5]];  // alpha + beta N
  /** @type {((w: Float64Array) => number)[]} */
  const of = [
    (w) => { const [r, i] = wall(w); return w[1] * r - w[0] * i; },
    (w) => { const [r, i] = wall(w); return Math.log((r * r + i * i) / (w[0] * w[0] + w[1] * w[1])); },
    (w) => { const [r, i] = wall(w); return 2 * (alpha + loop.gamma) ** 2 - (r - w[0]) ** 2 - (i - w[1]) ** 2; },
  ];
  const known = curve(loop).nodes, gains = [], phases = [], delays = /** @type {[number, number][]} */ ([]);
  let bandwidth = Infinity;
  const factor = (w) => { const [r, i] = wall(w); return (w[0] * r + w[1] * i) / (r * r + i * i); };
  for (let i = 1; i < known.length; i++) {
    of.forEach((function_, kind) => {
      if ((function_(known[i - 1].v) > 0) === (function_(known[i].v) > 0)) return;
      const { theta, v: w } = zero(loop, function_, known[i - 1], known[i], 0), [r, s] = wall(w);
      if (kind === 0) gains.push(factor(w));
      if (kind === 2) bandwidth = Math.min(bandwidth, theta);
      if (kind === 1) {
        const phase = Math.atan2(s * w[0] - r * w[1], r * w[0] + s * w[1]);  // of -L = (alpha + beta N)/H
        phases.push(Math.abs(phase));
        delays.push([((phase % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI) / theta, theta]);
      }
    });
  }
  onCircle(loop, Math.PI, v);
  gains.push(factor(v));
  const least = (values) => values.length ? Math.min(...values) : null, down = gains.filter((x) => x > 0 && x < 1);
  return {
    gain: least(gains.filter((x) => x > 1)), gain_down: down.length ? Math.max(...down) : null, phase: least(phases),
    delay: least(delays.sort((p, q) => p[0] - q[0]).slice(0, 2).map(([added, theta]) => delayAt(loop, alpha, beta, theta, added)).filter((added) => added !== null)),
    bandwidth_hz: Number.isFinite(bandwidth) ? bandwidth / (2 * Math.PI * loop.units.period) : null,
  };
}

/**
 * Return the added delay [samples] at which a pole pair reaches the circle, near an angle; null where none is found.
 * @param {Sampled} loop @param {number} alpha @param {number} beta @param {number} theta @param {number} added
 */
function delayAt(loop, alpha, beta, theta, added) {
  const v = new Float64Array(8);
  const miss = (t, d) => {
    const delay = loop.delay + Math.max(d, 0), whole = Math.floor(delay);
    onCircle(sampledDevice({ ...loop, delay, whole, fraction: delay - whole, curve: undefined, pieces: undefined }), t, v);
    return [alpha + beta * v[4] - v[0], beta * v[5] - v[1], beta * v[6] - v[2], beta * v[7] - v[3]];
  };
  for (let step = 0; step < 20; step++) {
    if (!(theta > 0 && theta < Math.PI && loop.delay + added <= LARGEST_DELAY)) return null;
    const [r, i, tr, ti] = miss(theta, added), h = 1e-6, [r2, i2] = miss(theta, added + h), dr = (r2 - r) / h, di = (i2 - i) / h;
    const whole = tr * di - ti * dr, change = (r * di - i * dr) / whole, later = (tr * i - ti * r) / whole;
    theta -= change, added = Math.max(added - later, 0);
    if (Math.abs(change) < 1e-10 && Math.abs(later) < 1e-9) return added;
  }
  return null;
}
