// Stage 5 with atomics: pixel gradients straight to the sums of rows, without records. The sums are those
// of rasterize_bwd.wgsl, in an order that is chance.
//
// One tile per group. Each invocation finds q and w of its pixel, back to front, and what the parameters
// need of them; a subgroup adds that up by itself, unless none of its pixels takes the splat. Over the
// subgroups, and to the rows: subgroups.wgsl.

// One pixel's share in splat i of the batch.
fn take(
    i: i32,
    is_taken: bool,
    m: Member,
    at: vec2<f32>,
    own: Upstream,
    pixel: ptr<function, Pixel>,
) {
    var found = vec2(0.0);
    if i >= 0 && is_taken {
        found = differentiated(u32(i), at, own, pixel);
    }
    var sums = array<f32, 15>();
    let stride = fields();
    if subgroupAny(found.y > 0.0) {
        if found.y > 0.0 {
            add_pixel(&sums, u32(i), at, found.x, found.y, own.rgb, own.depth);
        }
        for (var f = 0u; f < stride; f++) {
            if f == maximum() {
                sums[f] = subgroupMax(sums[f]);
            } else {
                sums[f] = subgroupAdd(sums[f]);
            }
        }
    }
    if m.is_first && i >= 0 {
        let first = (u32(i) * m.subgroups + m.subgroup) * stride;
        for (var f = 0u; f < stride; f++) {
            parts[first + f] = sums[f];
        }
    }
}

// now.a: the band.
@compute @workgroup_size(256)
fn rasterize_bwd_atomic(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_of(id);
    if tile >= frame.image.w || tile < state.cuts[now.a] || tile >= state.cuts[now.a + 1u] {
        return;
    }
    let corner = vec2(tile % frame.image.z, tile / frame.image.z) * TILE;
    let place = pixel_of(lane);
    let pixel = corner + place;
    let at = vec2<f32>(place) + 0.5;
    let begin = tile_starts[tile];
    let length = tile_starts[tile + 1u] - begin;

    let own = upstream(pixel);
    var ours = Pixel(1.0, dot(own.rgb, frame.background.xyz));
    var stop = 0u;
    if pixel.x < frame.image.x && pixel.y < frame.image.y {
        let finished = finish[pixel.y * frame.image.x + pixel.x];
        ours.light = bitcast<f32>(finished.x);
        stop = min(finished.y, length);
    }
    let taken = taken_by_any(lane, stop);
    let m = member(lane);
    let stride = fields();
    let most = room(m, stride);
    let batches = (taken + most - 1u) / most;
    for (var n = 0u; n < batches; n++) {
        let first = (batches - 1u - n) * most;
        let count = min(most, taken - first);
        workgroupBarrier();
        if lane < count {
            let row = row_of_slot[list[begin + first + lane]];
            rows[lane] = row;
            load(lane, row, corner);
        }
        workgroupBarrier();
        // Four in a round, written out: compilers do not unroll as much as this is, and rounds are
        // counted (rasterize_bwd.wgsl says where).
        for (var top = i32(count); top > 0; top -= i32(SPLATS)) {
            let last = i32(stop) - i32(first);
            take(top - 1, top - 1 < last, m, at, own, &ours);
            take(top - 2, top - 2 < last, m, at, own, &ours);
            take(top - 3, top - 3 < last, m, at, own, &ours);
            take(top - 4, top - 4 < last, m, at, own, &ours);
        }
        workgroupBarrier();
        deliver(m, lane, count, stride, maximum());
    }
}

// Sets the sums of all rows to 0, before the first band; now.a: numbers per row.
@compute @workgroup_size(256)
fn clear_sums(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group_of(id) * GROUP + lane;
    if row < frame.model.x {
        for (var f = 0u; f < now.a; f++) {
            clear(row * now.a + f);
        }
    }
}
