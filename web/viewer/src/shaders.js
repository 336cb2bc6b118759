// The equations of docs/drawing.md.

export const SPLAT_VERTEX = `#version 300 es
layout(location = 0) in uint word;  // row, and steps below the level of sort.js
uniform highp usampler2D data, sh;
uniform mat3 toCamera;
uniform vec3 eye;
uniform vec2 focal, middle, size;
uniform float near, growth;
uniform vec3 low, high;
uniform int degree, shTexels, shPerLine;
uniform bool antialiased;
flat out vec2 centre;
flat out vec3 conic;
flat out vec4 colour;

const float DILATION = 0.3;
const float GROWN = 0.00866434;  // a step's part of the logarithm, as growthOf in some.js
const float SHARE_MIN = 1.0 / (255.0 * 255.0);

int firstSh;

uvec4 texel(int k) {
  int at = int(word & 0x7fffffu) * 4 + k;
  return texelFetch(data, ivec2(at & 2047, at >> 11), 0);
}

// Halves of coefficient k, red green blue, at place 3 k of the row.
float shHalf(int place) {
  int word = place >> 1;
  int at = firstSh % shPerLine * shTexels + (word >> 2);
  uvec4 four = texelFetch(sh, ivec2(at, firstSh / shPerLine), 0);
  vec2 both = unpackHalf2x16(four[word & 3]);
  return (place & 1) == 0 ? both.x : both.y;
}

vec3 coefficient(int k) {
  return vec3(shHalf(3 * k), shHalf(3 * k + 1), shHalf(3 * k + 2));
}

vec3 shOf(vec3 d, int most) {
  float x = d.x, y = d.y, z = d.z;
  vec3 sum = 0.4886025119029199 * (z * coefficient(1) - y * coefficient(0) - x * coefficient(2));
  if (most < 2) return sum;
  float xx = x * x, yy = y * y, zz = z * z;
  sum += 1.0925484305920792 * (x * y * coefficient(3) - y * z * coefficient(4) - x * z * coefficient(6));
  sum += 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficient(5) + 0.5462742152960396 * (xx - yy) * coefficient(7);
  if (most < 3) return sum;
  sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * coefficient(8) + x * (xx - 3.0 * yy) * coefficient(14));
  sum += 2.890611442640554 * x * y * z * coefficient(9) + 1.445305721320277 * z * (xx - yy) * coefficient(13);
  sum += -0.4570457994644658 * (4.0 * zz - xx - yy) * (y * coefficient(10) + x * coefficient(12));
  sum += 0.3731763325901154 * z * (2.0 * zz - 3.0 * (xx + yy)) * coefficient(11);
  if (most < 4) return sum;
  sum += 2.5033429417967046 * x * y * (xx - yy) * coefficient(15);
  sum += -1.7701307697799304 * (y * z * (3.0 * xx - yy) * coefficient(16) + x * z * (xx - 3.0 * yy) * coefficient(22));
  sum += 0.9461746957575601 * x * y * (7.0 * zz - 1.0) * coefficient(17);
  sum += -0.6690465435572892 * z * (7.0 * zz - 3.0) * (y * coefficient(18) + x * coefficient(20));
  sum += 0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0) * coefficient(19);
  sum += 0.47308734787878004 * (xx - yy) * (7.0 * zz - 1.0) * coefficient(21);
  sum += 0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)) * coefficient(23);
  return sum;
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside: not shown
  uvec4 t0 = texel(0), t1 = texel(1);
  vec3 here = uintBitsToFloat(t0.xyz), away = here - eye;
  vec3 p = toCamera * away;
  float opacity = 1.0 / (1.0 + exp(-uintBitsToFloat(t1.w)));
  if (!(p.z > near) || opacity < 1.0 / 255.0 || here != clamp(here, low, high)) return;

  // The covariance's factor, then its projection: rows of J R M.
  vec4 q = normalize(uintBitsToFloat(texel(2)));
  float grown = growth * exp(GROWN * float(word >> 23));
  vec3 s = grown * exp(uintBitsToFloat(t1.xyz));
  float w = q.x, x = q.y, y = q.z, z = q.w;
  mat3 m = mat3(
    s.x * vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
    s.y * vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
    s.z * vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)));
  vec2 uv = p.xy / p.z;
  vec2 edge = 0.15 * size;
  vec2 clamped = clamp(uv, -(middle + edge) / focal, (size - 1.0 - middle + edge) / focal);
  mat3 rows = transpose(toCamera);
  vec2 scale = focal / p.z;
  vec3 g0 = (scale.x * (rows[0] - clamped.x * rows[2])) * m;
  vec3 g1 = (scale.y * (rows[1] - clamped.y * rows[2])) * m;
  vec3 area = cross(g0, g1);
  float before = dot(area, area);
  float a = dot(g0, g0), b = dot(g0, g1), c = dot(g1, g1);
  float det = before + DILATION * (a + c) + DILATION * DILATION;
  a += DILATION;
  c += DILATION;
  if (!(det > 0.0) || isinf(det)) return;
  if (antialiased) {
    float share = before / det;
    opacity *= sqrt(share);
    if (share < SHARE_MIN || opacity < 1.0 / 255.0) return;
  }

  // A quad around the ellipse on which alpha is 1/255, and a pixel more.
  float reach = 2.0 * log(255.0 * opacity);
  float mid = 0.5 * (a + c), spread = length(vec2(0.5 * (a - c), b));
  float angle = spread > 0.0 ? 0.5 * atan(2.0 * b, a - c) : 0.0;
  vec2 axis = vec2(cos(angle), sin(angle));
  vec2 half_axes = sqrt(reach * vec2(mid + spread, max(mid - spread, 0.0))) + 1.0;
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  centre = focal * uv + middle;
  vec2 place = centre + corner.x * half_axes.x * axis + corner.y * half_axes.y * vec2(-axis.y, axis.x);
  gl_Position = vec4((2.0 * place + 1.0) / size - 1.0, 0.0, 1.0);
  gl_Position.y = -gl_Position.y;
  conic = vec3(c, -b, a) / det;

  uvec4 t3 = texel(3);
  vec3 light = 0.28209479177387814 * uintBitsToFloat(t3.xyz) + 0.5;
  int most = min(int(t3.w), degree);
  if (most > 0) {
    firstSh = int(t0.w);
    light += shOf(normalize(away), most);
  }
  colour = vec4(max(light, 0.0), opacity);
}
`;

export const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
uniform vec2 size;
flat in vec2 centre;
flat in vec3 conic;
flat in vec4 colour;
out vec4 result;

void main() {
  vec2 d = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - 0.5 - centre;
  float q = max(conic.x * d.x * d.x + 2.0 * conic.y * d.x * d.y + conic.z * d.y * d.y, 0.0);
  float alpha = min(0.99, colour.a * exp(-0.5 * q));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(alpha * colour.rgb, alpha);
}
`;

export const FINAL_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}
`;

export const FINAL_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform vec3 background;
out vec4 result;

void main() {
  vec4 sum = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  result = vec4(sum.rgb + (1.0 - sum.a) * background, 1.0);
}
`;
