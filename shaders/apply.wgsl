// Stage 9: executes a compiled plan in place, in chunks of operations, as in src/render/cpu/apply.rs. Pass 1 writes
// families (the children of grown rows), updates and seeds (new rows), each row at most once; pass 2 moves rows from
// the end into holes and sorts the rows. Each buffer is edited separately; buffers without frozen rows start at the
// first row that is not frozen.

// Words per operation.
const WORDS: u32 = 20u;

@group(0) @binding(1) var<storage, read> ops: array<u32>;
// Any buffer with one or several numbers per row.
@group(0) @binding(2) var<storage, read_write> buffer: array<u32>;
@group(0) @binding(5) var<storage, read_write> rows: array<RowPart>;
@group(0) @binding(6) var<storage, read_write> sh0: array<Coefficient>;
@group(0) @binding(7) var<storage, read_write> waiting_rows: array<f32>;
@group(0) @binding(8) var<storage, read> signals: array<f32>;

// The operation of an invocation, and the index of the number that it edits. launch.a: number of operations,
// launch.b: numbers per row, launch.c: stride of rows, launch.d: stride of the numbers of a row.
fn operation_of(id: vec3<u32>) -> vec2<u32> {
    let i = index_of(id);
    return vec2(i / launch.b, i % launch.b);
}

fn place_of(row: u32, number: u32) -> u32 {
    return row * launch.c + number * launch.d;
}

// Operations (from, to): copies row `from` to `to`, or clears `to` if `from` is NONE.
@compute @workgroup_size(256)
fn copy_rows(@builtin(global_invocation_id) id: vec3<u32>) {
    let op = operation_of(id);
    if op.x >= launch.a {
        return;
    }
    let source = ops[2u * op.x];
    let to = place_of(ops[2u * op.x + 1u], op.y);
    if source == NONE {
        buffer[to] = 0u;
    } else {
        buffer[to] = buffer[place_of(source, op.y)];
    }
}

// Operations (a, b): swaps two rows; no row occurs twice.
@compute @workgroup_size(256)
fn swap_rows(@builtin(global_invocation_id) id: vec3<u32>) {
    let op = operation_of(id);
    if op.x >= launch.a {
        return;
    }
    let a = place_of(ops[2u * op.x], op.y);
    let b = place_of(ops[2u * op.x + 1u], op.y);
    let kept = buffer[a];
    buffer[a] = buffer[b];
    buffer[b] = kept;
}

fn longest(s: vec3<f32>) -> u32 {
    var best = 0u;
    if s.y > s[best] { best = 1u; }
    if s.z > s[best] { best = 2u; }
    return best;
}

// Log-scales changed by the rule at ops[at], whose three terms follow in `ops`. Rule 0: the first term is added to
// all; 1: the first is added to the longest axis, the second to the others; 2: each to its own axis; 3: all are set
// to the first.
fn scales_of(s: vec3<f32>, at: u32) -> vec3<f32> {
    let rule = ops[at];
    let terms = vec3(real(at + 1u), real(at + 2u), real(at + 3u));
    if rule == 0u {
        return s + terms.x;
    }
    if rule == 2u {
        return s + terms;
    }
    if rule == 3u {
        return vec3(terms.x);
    }
    var changed = s + terms.y;
    let long = longest(s);
    changed[long] = s[long] + terms.x;
    return changed;
}

// ln(o / (1 − o)), given 1 − o at full precision.
fn logit_of(opacity: f32, complement: f32) -> f32 {
    return log(opacity) - log(complement);
}

// A logit changed by a rule. Rule 0: unchanged; 1: set to `value`; 2: opacity times `value`; 3: `value` siblings
// together transmit as much light as the parent.
fn logit_after(logit: f32, rule: u32, value: f32) -> f32 {
    let opacity = sigmoid(logit);
    let complement = sigmoid(-logit);
    switch rule {
        case 1u: { return value; }
        case 2u: {
            // 1 − o·f as (1 − o) + o·(1 − f), without cancellation.
            return logit_of(opacity * value, complement + opacity * (1.0 - value));
        }
        case 3u: {
            let left = pow(complement, 1.0 / value);
            // 1 − left; computed by a series if it is small, because the difference would cancel.
            let ln_left = -minus_ln_complement(opacity, complement) / value;
            let part = select(1.0 - left, -expm1_small(ln_left), ln_left > -0.1);
            return logit_of(part, left);
        }
        default: { return logit; }
    }
}

// −ln(1 − o).
fn minus_ln_complement(opacity: f32, complement: f32) -> f32 {
    if opacity < 0.1 {
        let t = opacity / (2.0 - opacity);
        let t2 = t * t;
        return 2.0 * t * (1.0 + t2 * (1.0 / 3.0 + t2 * (1.0 / 5.0 + t2 * (1.0 / 7.0))));
    }
    return -log(complement);
}

// e^x − 1 for −0.1 < x <= 0.
fn expm1_small(x: f32) -> f32 {
    return x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0)))));
}

fn real(at: u32) -> f32 {
    return bitcast<f32>(ops[at]);
}

fn quaternion_at(at: u32) -> vec4<f32> {
    return vec4(real(at), real(at + 1u), real(at + 2u), real(at + 3u));
}

// The product of quaternions (w, x, y, z).
fn product(a: vec4<f32>, b: vec4<f32>) -> vec4<f32> {
    return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

// Writes families; launch.a: their number, launch.b: seed, launch.c: step. Words of an operation: parent; index in
// `ops` of the first child's row; number of children; index of the first child in its family; 1 if the
// parent is overwritten by child 0; placement (0: offset, 1: sampled, 2: along the longest axis,
// 3: along all axes) and three numbers for it; scale rule and three numbers; opacity rule and its
// number; rotation ×4; unused.
@compute @workgroup_size(256)
fn breed(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    if i >= launch.a {
        return;
    }
    let op = i * WORDS;
    let parent = ops[op];
    let known = load_row(parent);
    let mean = known.mean;
    let log_scale = known.log_scale;
    let quat = known.quat;
    let scales = scales_of(log_scale, op + 9u);
    let logit = logit_after(known.logit, ops[op + 13u], real(op + 14u));
    let turned = product(quat, quaternion_at(op + 15u));
    let children = ops[op + 2u];
    for (var k = 0u; k < children; k++) {
        let at = mean + offset_of(op, ops[op + 3u] + k, parent, log_scale, quat);
        store_row(ops[ops[op + 1u] + k], Row(at, scales, turned, logit));
    }
    if ops[op + 4u] != 0u {
        let at = mean + offset_of(op, 0u, parent, log_scale, quat);
        store_row(parent, Row(at, scales, turned, logit));
    }
}

fn offset_of(op: u32, child: u32, parent: u32, log_scale: vec3<f32>, quat: vec4<f32>) -> vec3<f32> {
    switch ops[op + 5u] {
        case 0u: {
            if child == 0u {
                return vec3(0.0);
            }
            return vec3(real(op + 6u), real(op + 7u), real(op + 8u));
        }
        case 1u: {
            let xi = normal3(parent, launch.c, launch.b, PURPOSE_PLACE, child);
            let scale = vec3(exp_exact(log_scale.x), exp_exact(log_scale.y), exp_exact(log_scale.z));
            return rotate(quat, scale * xi);
        }
        case 3u: {
            let scale = vec3(exp_exact(log_scale.x), exp_exact(log_scale.y), exp_exact(log_scale.z));
            let sigmas = vec3(real(op + 6u), real(op + 7u), real(op + 8u));
            return rotate(quat, select(-1.0, 1.0, child % 2u == 0u) * sigmas * scale);
        }
        default: {
            let long = longest(log_scale);
            var local = vec3(0.0);
            local[long] = select(-1.0, 1.0, child % 2u == 0u) * real(op + 6u) * exp_exact(log_scale[long]);
            return rotate(quat, local);
        }
    }
}

// Writes updates; launch.a: their number. Words of an operation: row; scale rule and three numbers; opacity rule
// and its number; 1 if the mean is set; the mean; 1 if band 0 is set; its three coefficients; unused ×5.
@compute @workgroup_size(256)
fn rewrite(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    if i >= launch.a {
        return;
    }
    let op = i * WORDS;
    let row = ops[op];
    var known = load_row(row);
    known.log_scale = scales_of(known.log_scale, op + 1u);
    if ops[op + 7u] != 0u {
        known.mean = vec3(real(op + 8u), real(op + 9u), real(op + 10u));
    }
    if ops[op + 11u] != 0u {
        store_band0(row, vec3(real(op + 12u), real(op + 13u), real(op + 14u)));
    }
    known.logit = logit_after(known.logit, ops[op + 5u], real(op + 6u));
    store_row(row, known);
}

// Writes seeds; launch.a: their number. Words of an operation: row; mean; log-scales; quaternion; logit; three
// coefficients of band 0; unused ×5. The other coefficients have been cleared.
@compute @workgroup_size(256)
fn sow(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = index_of(id);
    if i >= launch.a {
        return;
    }
    let op = i * WORDS;
    let row = ops[op];
    let mean = vec3(real(op + 1u), real(op + 2u), real(op + 3u));
    let log_scale = vec3(real(op + 4u), real(op + 5u), real(op + 6u));
    store_row(row, Row(mean, log_scale, quaternion_at(op + 7u), real(op + 11u)));
    store_band0(row, vec3(real(op + 12u), real(op + 13u), real(op + 14u)));
}

// Opacities do not decay below this.
const OPACITY_LEAST: f32 = 2e-4;

// Decays opacities and scales; launch.a: number of rows, launch.b: bits of the amount subtracted from opacities,
// launch.c: bits of the logarithm of the factor of scales, launch.d: start of the per-row counts of views in
// `signals` if only rows seen by a view decay, or else NONE. ops[0]: the first row that is not frozen.
@compute @workgroup_size(256)
fn decay(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < ops[0] || row >= launch.a {
        return;
    }
    if launch.d != NONE && !(signals[launch.d + row - ops[0]] > 0.0) {
        return;
    }
    let decrease = bitcast<f32>(launch.b);
    var known = load_row(row);
    let logit = known.logit;
    // Values that are not finite are left for the audit to find.
    if decrease > 0.0 && below(logit, LARGEST) {
        let opacity = sigmoid(logit);
        let left = max(opacity - decrease, OPACITY_LEAST);
        known.logit = min(logit, logit_of(left, sigmoid(-logit) + (opacity - left)));
    }
    known.log_scale += bitcast<f32>(launch.c);
    store_row(row, known);
}

// Caps all opacities and clears their moments; launch.a: number of rows, launch.b: bits of the largest logit,
// launch.c: 1 if there are waiting gradients to clear. ops[0]: the first row that is not frozen.
@compute @workgroup_size(256)
fn clamp_opacity(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < ops[0] || row >= launch.a {
        return;
    }
    var known = load_row(row);
    known.logit = min(known.logit, bitcast<f32>(launch.b));
    store_row(row, known);
    let own = row - ops[0];
    // The opacity's pair; the other number is padding.
    store_moments(own, 12u, 5u, row, 10u, Moments(vec2(0.0), vec2(0.0)));
    if launch.c != 0u {
        waiting_rows[12u * own + 10u] = 0.0;
    }
}
