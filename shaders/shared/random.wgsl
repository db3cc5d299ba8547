// Random numbers as hashes of (seed, step, row, purpose), the counterpart of policies/src/rng.rs;
// uniform numbers agree bit for bit. Normal numbers use the logarithm, sine and cosine defined here,
// since a device's own may have errors of 2^-11.

const PURPOSE_PLACE: u32 = 2u;
const PURPOSE_NOISE: u32 = 3u;

fn pcg4d(key: vec4<u32>) -> vec4<u32> {
    var v = key * 1664525u + 1013904223u;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    v ^= v >> vec4(16u);
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    return v;
}

fn draw_bits(row: u32, step: u32, seed: u32, purpose: u32, counter: u32) -> vec4<u32> {
    return pcg4d(vec4(row, step, seed, (purpose << 16u) ^ counter));
}

// The top 23 bits as a number strictly between 0 and 1.
fn unit_open(bits: vec4<u32>) -> vec4<f32> {
    return (vec4<f32>(bits >> vec4(9u)) + 0.5) * (1.0 / 8388608.0);
}

// ln x for x in (0, 1): x = m·2^n with m in [2/3, 4/3).
fn ln_exact(x: f32) -> f32 {
    let bits = bitcast<u32>(x);
    let n = i32(bits - 0x3f2aaaabu) >> 23u;
    let m = bitcast<f32>(bits - (bitcast<u32>(n) << 23u));
    let t = (m - 1.0) / (m + 1.0);
    let t2 = t * t;
    var p = fma(1.0 / 11.0, t2, 1.0 / 9.0);
    p = fma(p, t2, 1.0 / 7.0);
    p = fma(p, t2, 1.0 / 5.0);
    p = fma(p, t2, 1.0 / 3.0);
    p = fma(p, t2, 1.0);
    return f32(n) * 0.6931471806 + 2.0 * t * p;
}

// Cosine and sine of an angle in turns, in [0, 1).
fn cos_sin_of_turn(turn: f32) -> vec2<f32> {
    let quarter = round(4.0 * turn);
    let x = (turn - 0.25 * quarter) * 6.2831853072;
    let x2 = x * x;
    var s = fma(2.7557319e-6, x2, -1.9841270e-4);
    s = fma(s, x2, 8.3333333e-3);
    s = fma(s, x2, -1.6666667e-1);
    s = fma(s, x2, 1.0) * x;
    var c = fma(2.4801587e-5, x2, -1.3888889e-3);
    c = fma(c, x2, 4.1666667e-2);
    c = fma(c, x2, -0.5);
    c = fma(c, x2, 1.0);
    switch u32(quarter) & 3u {
        case 0u: { return vec2(c, s); }
        case 1u: { return vec2(-s, c); }
        case 2u: { return vec2(-c, -s); }
        default: { return vec2(s, -c); }
    }
}

// Three independent standard normals, by Box-Muller.
fn normal3(row: u32, step: u32, seed: u32, purpose: u32, counter: u32) -> vec3<f32> {
    let u = unit_open(draw_bits(row, step, seed, purpose, counter));
    let a = sqrt(-2.0 * ln_exact(u.x)) * cos_sin_of_turn(u.y);
    let b = sqrt(-2.0 * ln_exact(u.z)) * cos_sin_of_turn(u.w);
    return vec3(a, b.x);
}

// R(q)·v for a quaternion (w, x, y, z) of any length but 0.
fn rotate(quat: vec4<f32>, v: vec3<f32>) -> vec3<f32> {
    let q = quat / sqrt(dot(quat, quat));
    let t = 2.0 * cross(q.yzw, v);
    return v + q.x * t + cross(q.yzw, t);
}
