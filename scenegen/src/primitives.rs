//! Shapes and painted textures of the presets.

use std::f64::consts::{PI, TAU};

use glam::{DQuat, DVec2, DVec3, Vec2, Vec3};

use crate::mesh::{Material, Model};
use crate::random::Draws;
use crate::texture::{Texture, TextureRef, encode};

impl Model {
    /// A sphere of `20 · 4^level` triangles with all corners on the sphere and smooth normals. Texture
    /// coordinates are the longitude and latitude of the corners.
    pub(crate) fn sphere(&mut self, centre: DVec3, radius: f64, level: u32, material: u32) {
        self.ball(level, material, |out| (centre + radius * out, out));
    }

    /// A deformed sphere: `shape` returns position and unit normal of the corner in each direction.
    pub(crate) fn ball(
        &mut self,
        level: u32,
        material: u32,
        shape: impl Fn(DVec3) -> (DVec3, DVec3),
    ) {
        let (corners, triangles) = icosphere(level);
        // Triangles do not share corners, so that texture coordinates can exceed 1 where the longitude wraps.
        let (mut positions, mut normals, mut uvs) = (Vec::new(), Vec::new(), Vec::new());
        for triangle in &triangles {
            let corners = triangle.map(|i| corners[i as usize]);
            let middle = longitude(corners[0] + corners[1] + corners[2]);
            for p in corners {
                let (place, normal) = shape(p);
                positions.push(place);
                normals.push(normal.as_vec3());
                let u = longitude(p);
                let u = u - (u - middle).round();
                uvs.push(Vec2::new(u as f32, (p.y.clamp(-1.0, 1.0).acos() / PI) as f32));
            }
        }
        self.add(&positions, &normals, &uvs, &consecutive(positions.len()), material);
    }

    /// A parallelogram from `corner` along `u` and `v`, seen from the side of `u x v`. The image
    /// is upright when `v` points up.
    pub(crate) fn quad(&mut self, corner: DVec3, u: DVec3, v: DVec3, material: u32) {
        self.tiled(corner, u, v, [0.0, 1.0], [1.0, 1.0], material);
    }

    /// [`Model::quad`] with the image repeated `times` along `u` and `v`; `first` are the texture coordinates at
    /// `corner`.
    pub(crate) fn tiled(
        &mut self,
        corner: DVec3,
        u: DVec3,
        v: DVec3,
        first: [f32; 2],
        times: [f32; 2],
        material: u32,
    ) {
        let positions = [corner, corner + u, corner + u + v, corner + v];
        let uvs = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
            .map(|(x, y)| Vec2::new(first[0] + x * times[0], first[1] - y * times[1]));
        self.add(&positions, &[], &uvs, &[[0, 1, 2], [0, 2, 3]], material);
    }

    /// A box with the given half sides, rotated by `turn`; every face shows the whole texture. With negative
    /// half sides it is visible from inside.
    pub(crate) fn cuboid(&mut self, centre: DVec3, half: DVec3, turn: DQuat, material: u32) {
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let mut normal = DVec3::ZERO;
                normal[axis] = sign;
                let up = if axis == 1 { DVec3::Z * -sign } else { DVec3::Y };
                let right = up.cross(normal);
                let (u, v) = (2.0 * right * half.abs(), 2.0 * up * half.abs());
                let corner = half * normal - 0.5 * (u + v);
                self.quad(centre + turn * corner, turn * u, turn * v, material);
            }
        }
    }

    /// A cylinder from `a` to `b` with `sides` sides, closed at both ends; its corners lie on the
    /// circle of the given radius.
    pub(crate) fn cylinder(&mut self, a: DVec3, b: DVec3, radius: f64, sides: u32, material: u32) {
        let axis = (b - a).normalize_or(DVec3::Y);
        let (x, y) = axis.any_orthonormal_pair();
        let (mut positions, mut normals, mut uvs) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..=sides {
            let share = f64::from(i) / f64::from(sides);
            let out = (share * TAU).cos() * x + (share * TAU).sin() * y;
            for (end, v) in [(a, 1.0), (b, 0.0)] {
                positions.push(end + radius * out);
                normals.push(out.as_vec3());
                uvs.push(Vec2::new(share as f32, v));
            }
        }
        let side = |i: u32| [[2 * i, 2 * i + 2, 2 * i + 3], [2 * i, 2 * i + 3, 2 * i + 1]];
        let triangles: Vec<_> = (0..sides).flat_map(side).collect();
        self.add(&positions, &normals, &uvs, &triangles, material);
        for (end, normal, first) in [(a, -axis, 0_u32), (b, axis, 1)] {
            let mut rim: Vec<DVec3> = vec![end];
            let disc = |p: &DVec3| {
                let out = (*p - end) * (0.5 / radius);
                Vec2::new(0.5 + out.dot(x) as f32, 0.5 + out.dot(y) as f32)
            };
            rim.extend((0..sides).map(|i| positions[(2 * i + first) as usize]));
            let next = |i: u32| 1 + (i + 1) % sides;
            let fan = (0..sides)
                .map(|i| if first == 1 { [0, 1 + i, next(i)] } else { [0, next(i), 1 + i] });
            let normals = vec![normal.as_vec3(); rim.len()];
            let uvs: Vec<Vec2> = rim.iter().map(disc).collect();
            self.add(&rim, &normals, &uvs, &fan.collect::<Vec<_>>(), material);
        }
    }

    /// A texture of `size` x `size` texels painted by a function of (u, v) that returns linear
    /// colours.
    pub(crate) fn paint(&mut self, size: u32, colour: impl Fn(DVec2) -> Vec3) -> TextureRef {
        let mut texels = Vec::with_capacity(4 * (size * size) as usize);
        for y in 0..size {
            for x in 0..size {
                let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) / f64::from(size);
                let mean = colour(at);
                texels.extend([encode(mean.x), encode(mean.y), encode(mean.z), 255]);
            }
        }
        self.textures.push(Texture::new(size, size, texels, true));
        TextureRef::new(self.textures.len() as u32 - 1)
    }

    /// A diffuse material with a painted texture.
    pub(crate) fn painted(&mut self, name: &str, size: u32, colour: impl Fn(DVec2) -> Vec3) -> u32 {
        let texture = self.paint(size, colour);
        let material = Material::lambert(name, [1.0; 3]);
        self.material(Material { base_texture: Some(texture), ..material })
    }
}

/// Smooth noise in `[0, 1]` that repeats with the unit square: `octaves` lattices, the first with `cells` cells,
/// each following one twice as fine and half as strong.
pub(crate) fn noise(at: DVec2, cells: u32, octaves: u32, seed: u64) -> f64 {
    let (mut sum, mut weight, mut total) = (0.0, 1.0, 0.0);
    for octave in 0..octaves {
        let cells = cells << octave;
        let p = at * f64::from(cells);
        let (floor, share) = (p.floor(), p - p.floor());
        let smooth = share * share * (3.0 - 2.0 * share);
        let wrap = |v: f64| (v as i64).rem_euclid(i64::from(cells)) as u64;
        let lattice = Draws::new(seed, &[u64::from(octave)]);
        let columns = [0.0, 1.0].map(|dx| lattice.with(wrap(floor.x + dx)));
        let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let [upper, lower] = [0.0, 1.0].map(|dy| {
            let row = wrap(floor.y + dy);
            let [left, right] = columns.map(|column| column.with(row).unit64());
            mix(left, right, smooth.x)
        });
        sum += weight * mix(upper, lower, smooth.y);
        total += weight;
        weight *= 0.5;
    }
    sum / total
}

/// A colour between `from` and `to`, chosen by noise: a surface with detail at all scales.
pub(crate) fn marbled(at: DVec2, cells: u32, seed: u64, from: [f32; 3], to: [f32; 3]) -> Vec3 {
    let share = ((noise(at, cells, 4, seed) - 0.5) * 2.2 + 0.5).clamp(0.0, 1.0);
    Vec3::from(from).lerp(Vec3::from(to), share as f32)
}

/// True on the light squares of a chequered pattern of `count` x `count` squares.
pub(crate) fn chequered(at: DVec2, count: f64) -> bool {
    ((at.x * count).floor() + (at.y * count).floor()).rem_euclid(2.0) < 0.5
}

fn longitude(p: DVec3) -> f64 {
    p.z.atan2(p.x) / TAU
}

fn consecutive(corners: usize) -> Vec<[u32; 3]> {
    (0..corners as u32 / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect()
}

/// Corners on the unit sphere and triangles of a subdivided icosahedron.
pub(crate) fn icosphere(level: u32) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let g = (1.0 + 5.0_f64.sqrt()) / 2.0;
    let mut corners: Vec<DVec3> = Vec::new();
    for shift in 0..3 {
        for (a, b) in [(-1.0, g), (1.0, g), (-1.0, -g), (1.0, -g)] {
            let mut corner = [a, b, 0.0];
            corner.rotate_right(shift);
            corners.push(DVec3::from(corner).normalize());
        }
    }
    // Triangles are the triples of corners that are pairwise one edge apart: the shortest distance between corners.
    let edge = 2.0 / (1.0 + g * g).sqrt() + 1e-9;
    let near = |i: usize, j: usize| corners[i].distance(corners[j]) < edge;
    let mut triangles = Vec::new();
    for i in 0..12 {
        for j in i + 1..12 {
            for k in j + 1..12 {
                if near(i, j) && near(j, k) && near(k, i) {
                    let (a, b, c) = (corners[i], corners[j], corners[k]);
                    let outward = (b - a).cross(c - a).dot(a) > 0.0;
                    let (j, k) = if outward { (j, k) } else { (k, j) };
                    triangles.push([i as u32, j as u32, k as u32]);
                }
            }
        }
    }
    for _ in 0..level {
        let mut halves = std::collections::HashMap::new();
        let mut half = |a: u32, b: u32| {
            *halves.entry((a.min(b), a.max(b))).or_insert_with(|| {
                let middle = (corners[a as usize] + corners[b as usize]).normalize();
                corners.push(middle);
                corners.len() as u32 - 1
            })
        };
        let mut finer = Vec::with_capacity(4 * triangles.len());
        for [a, b, c] in triangles {
            let (ab, bc, ca) = (half(a, b), half(b, c), half(c, a));
            finer.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        triangles = finer;
    }
    (corners, triangles)
}
