// Stage 6: from splat gradients to parameter gradients, one row per invocation;
// src/render/cpu/project_bwd.rs derives the formulas. The results replace the row's splat and sums, which the rest of
// the step does not need (record.wgsl), so that gradients take no memory of their own.

// Sums of the records, one record per row.
@group(0) @binding(6) var<storage, read_write> row_sums: array<f32>;
@group(0) @binding(7) var<storage, read_write> splats: array<f32>;
// Derivatives with respect to the camera's twist: v and its spare, ω and the logarithm of the focal lengths, of each
// group of rows; then of all.
@group(0) @binding(8) var<storage, read_write> pose_sums: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read_write> pose_total: array<vec4<f32>>;

// The twist of the camera in two columns: v and 0; ω and the logarithm of the focal lengths.
alias Twist = mat2x4<f32>;

alias Summand = Twist;
const ADDERS: u32 = GROUP;

@compute @workgroup_size(256)
fn project_bwd(@builtin(global_invocation_id) id: vec3<u32>) {
    differentiate_row(index_of(id));
}

// The same, and the sum of the derivatives with respect to the camera's twist over the group.
@compute @workgroup_size(256)
fn project_bwd_pose(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group_id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    reduced[lane] = differentiate_row(index_of(id));
    let sum = reduced_sum(lane);
    let group = group_of(group_id);
    if lane == 0u && group * GROUP < frame.model.x {
        pose_sums[2u * group] = sum[0];
        pose_sums[2u * group + 1u] = sum[1];
    }
}

// The sum over all rows; a single group.
@compute @workgroup_size(256)
fn total_pose(@builtin(local_invocation_index) lane: u32) {
    let groups = (frame.model.x + GROUP - 1u) / GROUP;
    var sum = Twist();
    for (var group = lane; group < groups; group += GROUP) {
        sum += Twist(pose_sums[2u * group], pose_sums[2u * group + 1u]);
    }
    reduced[lane] = sum;
    let all = reduced_sum(lane);
    if lane == 0u {
        pose_total[0] = all[0];
        pose_total[1] = all[1];
    }
}

// Replaces a row's splat and sums by its gradient, and returns the derivatives with respect to the camera's twist.
fn differentiate_row(i: u32) -> Twist {
    if i < frame.frozen.x || i >= frame.model.x {
        return Twist();
    }
    let at = i * RECORD;
    let splat = i * SPLAT;
    if !(splats[splat + DEPTH] > 0.0) {
        for (var k = 0u; k < OF_SPLAT; k++) {
            splats[splat + k] = 0.0;
        }
        for (var k = 0u; k < BASE; k++) {
            row_sums[at + k] = 0.0;
        }
        return Twist();
    }
    let row = load_row(i);
    let g = geometry(row);
    let factor = conic(g);
    let l1 = factor.x;
    let shear = factor.y;
    let l3 = factor.z;
    // Undo the scaling of the conic in the rasteriser's sums.
    let unscale = 1.0 / EXPONENT_SCALE;
    let q = row_sums[at];
    let qu = row_sums[at + 1u] * unscale;
    let qz = row_sums[at + 2u] * unscale;
    let muu = row_sums[at + 3u] * (unscale * unscale);
    let muz = row_sums[at + 4u] * (unscale * unscale);
    let mzz = row_sums[at + 5u] * (unscale * unscale);

    // Projected mean: L·Σ q·(u, z).
    let dm = vec2(l1 * qu, l3 * qz - l1 * shear * qu);
    // Columns of W without their scales (n), and M·n.
    let n0 = l1 * (g.n0 - shear * g.n1);
    let n1 = l3 * g.n1;
    let mn0 = muu * n0 + muz * n1;
    let mn1 = muz * n0 + mzz * n1;
    let scale2 = g.scale * g.scale;
    var by_log_scale = (n0 * mn0 + n1 * mn1) * scale2;
    // Rotation about axis i; j and k are the next two axes, cyclically.
    var turn = (n0.yzx * mn0.zxy + n1.yzx * mn1.zxy) * (scale2.yzx - scale2.zxy);
    // dL/d(row i of J·W) = Σ_k (L·M·n)[i][k]·sₖ²·axisₖ.
    var d0 = l1 * mn0 * scale2;
    var d1 = (l3 * mn1 - l1 * shear * mn0) * scale2;
    if LOWERS_OPACITY {
        let rho = rho_gradient(g, scale2, q);
        by_log_scale += rho.log_scale;
        turn += rho.turn;
        d0 += rho.row0;
        d1 += rho.row1;
    }
    let v = g.quat.yzw;
    let two = 2.0 * g.quat_inv_norm;
    let by_w = -dot(v, turn) * two;
    let by_v = (g.quat.x * turn + cross(v, turn)) * two;

    let db0 = d0.x * g.axis0 + d0.y * g.axis1 + d0.z * g.axis2;
    let db1 = d1.x * g.axis0 + d1.y * g.axis1 + d1.z * g.axis2;
    let r0 = frame.rotation[0].xyz;
    let r1 = frame.rotation[1].xyz;
    let r2 = frame.rotation[2].xyz;
    let j00 = dot(db0, r0);
    let j02 = dot(db0, r2);
    let j11 = dot(db1, r1);
    let j12 = dot(db1, r2);
    // J = f/z·[1, 0, −x/z; 0, 1, −y/z]; where x/z or y/z is clamped, that ratio is constant.
    let by_inv_z = frame.lens.x * (j00 - g.clamped.x * j02) + frame.lens.y * (j11 - g.clamped.y * j12);
    let free = g.clamped == g.ratio;
    let by_ratio = frame.lens.xy * (dm - select(vec2(0.0), g.inv_z * vec2(j02, j12), free));
    var by_depth = 0.0;
    if DEPTH_AT > 0u {
        by_depth = row_sums[at + DEPTH_AT];
    }
    let dp = vec3(
        by_ratio * g.inv_z,
        by_depth - g.inv_z * (dot(by_ratio, g.ratio) + g.inv_z * by_inv_z),
    );

    // Colour: through the clamp at 0 to the coefficients, and through the direction to the mean.
    let degree = frame.model.y;
    let towards = direction(row.mean);
    let d = towards.xyz;
    var y = basis(degree, d);
    let raw = raw_colour(i, degree, &y);
    let by_colour = vec3(row_sums[at + 6u], row_sums[at + 7u], row_sums[at + 8u]);
    let is_unclamped = raw > vec3(0.0);
    let dc = select(vec3(0.0), by_colour, is_unclamped);
    let by_d = direction_gradient(i, degree, d, dc);
    let from_d = (by_d - dot(by_d, d) * d) * towards.w;
    let by_mean = r0 * dp.x + r1 * dp.y + r2 * dp.z + from_d;

    // dα/d(logit) = α(1 − o); 1 − o = σ(−logit) keeps its precision near o = 1.
    let by_logit = q / (1.0 + exp_exact(row.logit));

    row_sums[at] = by_v.z;
    row_sums[at + LOGIT_AT] = by_logit;
    row_sums[at + MEAN_2D_AT] = dm.x;
    row_sums[at + MEAN_2D_AT + 1u] = dm.y;
    row_sums[at + UNCLAMPED_AT] = dot(select(vec3(0.0), vec3(1.0, 2.0, 4.0), is_unclamped), vec3(1.0));
    row_sums[at + L1_AT] = splats[splat + 2u];
    for (var k = 0u; k < 3u; k++) {
        splats[splat + k] = by_mean[k];
        splats[splat + 3u + k] = by_log_scale[k];
    }
    splats[splat + 6u] = by_w;
    splats[splat + 7u] = by_v.x;
    splats[splat + 8u] = by_v.y;

    let turned = turn.x * g.axis0 + turn.y * g.axis1 + turn.z * g.axis2;
    let in_camera = mat3x3(r0, r1, r2);
    let by_translation = dp + from_d * in_camera;
    let by_rotation = cross(g.p, dp) + turned * in_camera;
    let by_log_focal = dot(dm, frame.lens.xy * g.ratio) + dot(by_log_scale, vec3(1.0));
    return Twist(vec4(by_translation, 0.0), vec4(by_rotation, by_log_focal));
}

// The gradient through the factor of opacities with antialiasing: with respect to log-scales, to rotations about
// local axes, and to the rows of n.
struct RhoGradient {
    log_scale: vec3<f32>,
    turn: vec3<f32>,
    row0: vec3<f32>,
    row1: vec3<f32>,
}

// q: dL/d(log of the factor).
fn rho_gradient(g: Geometry, scale2: vec3<f32>, q: f32) -> RhoGradient {
    let per_det = q * BLUR / g.det;
    let by_sharp = per_det * (g.cov.x + g.cov.z - BLUR);
    let inv_norm = 1.0 / sqrt(g.sharp_det);
    let r0 = g.n0;
    let r1 = g.n1;
    let h = inv_norm * vec3(
        difference_of_products(r0.y, r1.z, r0.z, r1.y),
        difference_of_products(r0.z, r1.x, r0.x, r1.z),
        difference_of_products(r0.x, r1.y, r0.y, r1.x),
    );
    let unit = g.scale.yzx * g.scale.zxy * h;
    let unit2 = unit * unit;
    let length2 = (r0 * r0 + r1 * r1) * scale2;
    var rho: RhoGradient;
    rho.log_scale = by_sharp * (unit2.yzx + unit2.zxy) - per_det * length2;
    let sharp = (g.scale * h.yzx) * (g.scale * h.zxy);
    let both = by_sharp * sharp + per_det * (r0.yzx * r0.zxy + r1.yzx * r1.zxy);
    rho.turn = (scale2.zxy - scale2.yzx) * both;
    let across = by_sharp * inv_norm;
    let to0 = scale2.yzx * r1.yzx * h.zxy - scale2.zxy * r1.zxy * h.yzx;
    let to1 = scale2.zxy * r0.zxy * h.yzx - scale2.yzx * r0.yzx * h.zxy;
    rho.row0 = scale2 * (across * to0 - per_det * r0);
    rho.row1 = scale2 * (across * to1 - per_det * r1);
    return rho;
}

// Σ_k (dc·sh_k) ∇Y_k(d); see src/core/sh.rs.
fn direction_gradient(row: u32, degree: u32, d: vec3<f32>, dc: vec3<f32>) -> vec3<f32> {
    if degree == 0u {
        return vec3(0.0);
    }
    var by = C1 * vec3(
        -dot(dc, coefficient(row, 3u)),
        -dot(dc, coefficient(row, 1u)),
        dot(dc, coefficient(row, 2u)),
    );
    if degree == 1u {
        return by;
    }
    let g4 = C20 * dot(dc, coefficient(row, 4u));
    let g5 = -C20 * dot(dc, coefficient(row, 5u));
    let g6 = 2.0 * C22 * dot(dc, coefficient(row, 6u));
    let g7 = -C20 * dot(dc, coefficient(row, 7u));
    let g8 = 2.0 * C24 * dot(dc, coefficient(row, 8u));
    by += vec3(
        g4 * d.y - g6 * d.x + g7 * d.z + g8 * d.x,
        g4 * d.x + g5 * d.z - g6 * d.y - g8 * d.y,
        g5 * d.y + 2.0 * g6 * d.z + g7 * d.x,
    );
    if degree == 2u {
        return by;
    }
    let xx = d.x * d.x;
    let yy = d.y * d.y;
    let zz = d.z * d.z;
    let xy = d.x * d.y;
    let yz = d.y * d.z;
    let xz = d.x * d.z;
    let g9 = 3.0 * C30 * dot(dc, coefficient(row, 9u));
    let g10 = C31 * dot(dc, coefficient(row, 10u));
    let g11 = C32 * dot(dc, coefficient(row, 11u));
    let g12 = 3.0 * C33 * dot(dc, coefficient(row, 12u));
    let g13 = C32 * dot(dc, coefficient(row, 13u));
    let g14 = C35 * dot(dc, coefficient(row, 14u));
    let g15 = 3.0 * C30 * dot(dc, coefficient(row, 15u));
    by += vec3(
        2.0 * g9 * xy + g10 * yz - 2.0 * g11 * xy - 2.0 * g12 * xz
            + g13 * (4.0 * zz - 3.0 * xx - yy) + 2.0 * g14 * xz + g15 * (xx - yy),
        g9 * (xx - yy) + g10 * xz + g11 * (4.0 * zz - xx - 3.0 * yy) - 2.0 * g12 * yz
            - 2.0 * g13 * xy - 2.0 * g14 * yz - 2.0 * g15 * xy,
        g10 * xy + 8.0 * g11 * yz + g12 * (2.0 * zz - xx - yy) + 8.0 * g13 * xz + g14 * (xx - yy),
    );
    return by;
}
