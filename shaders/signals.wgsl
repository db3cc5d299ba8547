// Stage 8: accumulates the requested signals over views, as in src/render/cpu/signals.rs. One row per
// invocation. Each requested signal has planes of accumulators, with a number per row that is not frozen.

@group(0) @binding(2) var<storage, read_write> signals: array<f32>;
// The sums, and the derivatives that project_bwd.wgsl has left; see record.wgsl.
@group(0) @binding(4) var<storage, read> row_sums: array<f32>;
@group(0) @binding(6) var<storage, read> splats: array<f32>;
@group(0) @binding(7) var<storage, read> rows: array<RowPart>;
@group(0) @binding(8) var<storage, read> ages: array<u32>;
// Number of pixels that each row dominates, if they are counted.
@group(0) @binding(9) var<storage, read> dominant: array<u32>;
// Change of each mask's logit since its start, if there are masks.
@group(0) @binding(10) var<storage, read> mask_offsets: array<f32>;

const EXPONENT_SCALE: f32 = 0.8493218;
// A view counts as support of a row if the row's largest weight in the view is at least this.
override SUPPORT_WEIGHT: f32;

// Numbers of the signals, which index frame.planes; policies/src/signals.rs has the table.
override VISIBLE_COUNT: u32;
override SCREEN_GRADIENT: u32;
override SCREEN_GRADIENT_ABS: u32;
override COLOUR_GRADIENT: u32;
override MEAN_GRADIENT_X: u32;
override MEAN_GRADIENT_Y: u32;
override MEAN_GRADIENT_Z: u32;
override MEAN_GRADIENT_NORM: u32;
override WEIGHT_MAX: u32;
override WEIGHT_SUM: u32;
override PIXEL_COUNT: u32;
override WEIGHTED_ERROR: u32;
override ERROR_SCORE: u32;
override WEIGHT_MAX_ROOT: u32;
override SUPPORT: u32;
override DEPTH_MIN: u32;
override PIXEL_SIZE_MIN: u32;
override DOMINANT_PIXELS: u32;
override OPACITY: u32;
override SCALE_MAX: u32;
override SCALE_PRODUCT: u32;
override MASK: u32;
override AGE: u32;

fn plane(signal: u32) -> u32 {
    return frame.planes[signal / 4u][signal % 4u];
}

fn add(signal: u32, row: u32, value: f32) {
    let p = plane(signal);
    if p != NONE {
        signals[p * frame.model.w + row - frame.frozen.x] += value;
    }
}

fn raise(signal: u32, row: u32, value: f32) {
    let p = plane(signal);
    if p != NONE {
        let at = p * frame.model.w + row - frame.frozen.x;
        signals[at] = max(signals[at], value);
    }
}

@compute @workgroup_size(256)
fn accumulate(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < frame.frozen.x || row >= frame.model.x {
        return;
    }
    let splat = SPLAT * row;
    let depth = splats[splat + DEPTH];
    if !(depth > 0.0) {
        return;
    }
    let at = row * RECORD;
    let half = 0.5 * vec2<f32>(frame.image.xy);
    let by_mean = vec3(splats[splat], splats[splat + 1u], splats[splat + 2u]);
    let by_projected = vec2(row_sums[at + MEAN_2D_AT], row_sums[at + MEAN_2D_AT + 1u]);
    let colour = at + COLOUR_AT;
    let by_colour = vec3(row_sums[colour], row_sums[colour + 1u], row_sums[colour + 2u]);
    add(VISIBLE_COUNT, row, 1.0);
    let full = frame.background.w;
    var weight = 1.0;
    if depth < full {
        weight = (depth / full) * (depth / full);
    }
    add(SCREEN_GRADIENT, row, weight * norm2(by_projected * half));
    add(COLOUR_GRADIENT, row, weight * norm3(by_colour));
    add(MEAN_GRADIENT_X, row, by_mean.x);
    add(MEAN_GRADIENT_Y, row, by_mean.y);
    add(MEAN_GRADIENT_Z, row, by_mean.z);
    add(MEAN_GRADIENT_NORM, row, norm3(by_mean));
    if ABS_X_AT > 0u {
        // The sums are of scaled values (see project_bwd.wgsl), and the first sum lacks its factor l1.
        let unscale = 1.0 / EXPONENT_SCALE;
        let l1 = row_sums[at + L1_AT] * unscale;
        let by_x = l1 * unscale * row_sums[at + ABS_X_AT];
        let by_y = unscale * unscale * row_sums[at + ABS_Y_AT];
        add(SCREEN_GRADIENT_ABS, row, weight * norm2(vec2(by_x, by_y) * half));
    }
    if WEIGHT_SUM_AT > 0u {
        add(WEIGHT_SUM, row, row_sums[at + WEIGHT_SUM_AT]);
    }
    if PIXEL_COUNT_AT > 0u {
        add(PIXEL_COUNT, row, row_sums[at + PIXEL_COUNT_AT]);
    }
    if ERROR_AT > 0u {
        add(WEIGHTED_ERROR, row, row_sums[at + ERROR_AT]);
        if WEIGHT_SUM_AT > 0u {
            add(ERROR_SCORE, row, score(row_sums[at + ERROR_AT], row_sums[at + WEIGHT_SUM_AT]));
        }
    }
    if WEIGHT_MAX_AT > 0u {
        let largest = row_sums[at + WEIGHT_MAX_AT];
        raise(WEIGHT_MAX, row, largest);
        add(WEIGHT_MAX_ROOT, row, sqrt(largest));
        add(SUPPORT, row, select(0.0, 1.0, largest >= SUPPORT_WEIGHT));
    }
    // The smallest value is stored as the largest inverse, which can start at 0.
    raise(DEPTH_MIN, row, 1.0 / depth);
    raise(PIXEL_SIZE_MIN, row, 0.5 * (frame.lens.x + frame.lens.y) / depth);
    if plane(DOMINANT_PIXELS) != NONE {
        let pixels = f32(frame.image.x * frame.image.y);
        raise(DOMINANT_PIXELS, row, f32(dominant[row]) / pixels);
    }
}

// The score of one view, from the sums of weighted errors and of weights.
fn score(error: f32, weight: f32) -> f32 {
    if !(error > 0.0 && weight > 0.0) {
        return 0.0;
    }
    var score = error;
    if frame.score.z > 0.0 {
        score /= pow(weight, frame.score.z);
    }
    if frame.score.w < 1.0 {
        score = pow(score, frame.score.w);
    }
    return score;
}

// The norm, computed from scaled components because the squares of small gradients would underflow.
fn norm2(v: vec2<f32>) -> f32 {
    let most = max(abs(v.x), abs(v.y));
    if !(most > 0.0) {
        return 0.0;
    }
    let scaled = v / most;
    return most * sqrt(dot(scaled, scaled));
}

fn norm3(v: vec3<f32>) -> f32 {
    let most = max(max(abs(v.x), abs(v.y)), abs(v.z));
    if !(most > 0.0) {
        return 0.0;
    }
    let scaled = v / most;
    return most * sqrt(dot(scaled, scaled));
}

// Computes a signal from the current rows and writes it to the first plane of `signals`, here a scratch
// buffer. launch.a: the signal, launch.b: number of rows (`frame` may not be set yet), launch.c: bits of the
// initial logit of masks, launch.d: number of frozen rows, which are skipped.
@compute @workgroup_size(256)
fn present(@builtin(global_invocation_id) id: vec3<u32>) {
    let row = index_of(id);
    if row < launch.d || row >= launch.b {
        return;
    }
    let own = row - launch.d;
    let known = load_row(row);
    let s = known.log_scale;
    var value = 0.0;
    if launch.a == OPACITY {
        value = sigmoid(known.logit);
    } else if launch.a == MASK {
        value = sigmoid(bitcast<f32>(launch.c) + mask_offsets[own]);
    } else if launch.a == SCALE_MAX {
        value = exp_exact(max(max(s.x, s.y), s.z));
    } else if launch.a == SCALE_PRODUCT {
        value = exp_exact(s.x + s.y + s.z);
    } else if launch.a == AGE {
        value = f32(ages[own] & 0xffffu);
    }
    signals[own] = value;
}
