// Weighted sums of features, P (the value) and E (its error). They are integers below 2^53, so doubles hold them in any order.
// Each loop has a function of its own, which an engine compiles once.

export function fillSums(p, e, count, value, error) {
  p.fill(256 * value, 0, count);
  e.fill(256 * error, 0, count);
}

export function addFeature(p, e, count, feature, value, error) {
  if (value === 0 && error === 0) return;
  for (let i = 0; i < count; i++) {
    const f = feature[i];
    p[i] += value * f;
    e[i] += error * f;
  }
}

/** Value, mean and distance of an earlier channel; `at` is the place of their weights. */
export function addTriple(p, e, count, triple, group, at) {
  const { valueWeights: v, errorWeights: w } = group;
  addThree(p, e, count, triple[0], triple[1], triple[2], v[at], v[at + 1], v[at + 2], w[at], w[at + 1], w[at + 2]);
}

function addThree(p, e, count, one, two, three, v1, v2, v3, w1, w2, w3) {
  for (let i = 0; i < count; i++) {
    const a = one[i];
    const b = two[i];
    const c = three[i];
    p[i] += v1 * a + v2 * b + v3 * c;
    e[i] += w1 * a + w2 * b + w3 * c;
  }
}

/** Sums that begin with those of another pair, plus one feature. */
export function startSums(p, e, count, fromP, fromE, feature, value, error) {
  for (let i = 0; i < count; i++) {
    const f = feature[i];
    p[i] = fromP[i] + value * f;
    e[i] = fromE[i] + error * f;
  }
}

/** A feature and its magnitude. */
export function addWithSize(p, e, count, feature, group, at) {
  addPair(
    p, e, count, feature,
    group.valueWeights[at], group.valueWeights[at + 1], group.errorWeights[at], group.errorWeights[at + 1],
  ); // prettier-ignore
}

function addPair(p, e, count, feature, v1, v2, w1, w2) {
  for (let i = 0; i < count; i++) {
    const f = feature[i];
    const size = Math.abs(f);
    p[i] += v1 * f + v2 * size;
    e[i] += w1 * f + w2 * size;
  }
}

export function addSizes(sum, count, feature) {
  for (let i = 0; i < count; i++) sum[i] += Math.abs(feature[i]);
}
