//! Materials of a town. Each image covers some metres and repeats; colours that vary between houses are factors
//! on the image.

use glam::{DVec2, Vec3, Vec4, dvec2};

use crate::mesh::{Material, Model};
use crate::primitives::{marbled, noise};
use crate::random::Draws;
use crate::texture::TextureRef;

/// Number of bays and of floors in an image of windows.
pub(super) const BAYS: u32 = 4;

/// The materials of a house's walls.
#[derive(Debug, Clone, Copy)]
pub(super) struct Walls {
    /// Four bays of a ground floor.
    pub(super) ground: u32,
    /// Four by four bays of windows.
    pub(super) upper: u32,
    /// 3 x 3 m without windows.
    pub(super) plain: u32,
}

/// All materials, by their use. Sizes are the area that an image covers.
#[derive(Debug, Clone)]
pub(super) struct Materials {
    /// 12 x 12 m.
    pub(super) grass: u32,
    /// A street along z, its whole width.
    pub(super) street: u32,
    /// A street along x.
    pub(super) street_across: u32,
    pub(super) crossing: u32,
    /// 6 x 6 m of slabs.
    pub(super) paving: u32,
    /// A whole block.
    pub(super) park: u32,
    pub(super) houses: Vec<Walls>,
    pub(super) flats: Vec<Walls>,
    /// 3 x 3 m of tiles.
    pub(super) tiles: Vec<u32>,
    /// 4 x 4 m.
    pub(super) gravel: u32,
    pub(super) crowns: Vec<u32>,
    pub(super) bark: u32,
    pub(super) concrete: u32,
    pub(super) car_paint: Vec<u32>,
    pub(super) glass: u32,
    pub(super) rubber: u32,
    pub(super) pole: u32,
    pub(super) globe: u32,
}

impl Materials {
    pub(super) fn paint(model: &mut Model) -> Self {
        let ground = |at: DVec2| marbled(at, 12, 71, [0.1, 0.19, 0.04], [0.3, 0.4, 0.14]);
        let grass = model.painted("grass", 256, ground);
        let lengthways = model.paint(256, |at| street(dvec2(at.x, at.y)));
        let across = model.paint(256, |at| street(dvec2(at.y, at.x)));
        let street = tinted(model, "street", lengthways, [1.0; 3]);
        let street_across = tinted(model, "street", across, [1.0; 3]);
        let crossing = model.painted("crossing", 256, crossing);
        let paving = model.painted("paving", 256, |at| {
            let joint = (at * 6.0).fract().min_element() < 0.05;
            marbled(at, 24, 72, [0.38, 0.35, 0.32], [0.58, 0.55, 0.5])
                * if joint { 0.5 } else { 1.0 }
        });
        let park = model.painted("park", 512, move |at| {
            let out = (at - 0.5).abs();
            let ring = (out.length() - 0.2).abs() < 0.022;
            if ring || (out.min_element() < 0.025 && out.length() > 0.2) {
                marbled((at * 4.0).fract(), 32, 73, [0.5, 0.42, 0.3], [0.68, 0.6, 0.46])
            } else {
                ground((at * 3.25).fract())
            }
        });
        let (houses, flats) = all_walls(model);
        let tiles = roofs(model);
        let gravel =
            model.painted("gravel", 256, |at| marbled(at, 48, 78, [0.3, 0.29, 0.28], [0.55; 3]));
        let leaves = model.paint(256, |at| marbled(at, 24, 79, [0.25; 3], [1.0; 3]));
        let greens = [[0.2, 0.42, 0.1], [0.32, 0.46, 0.12], [0.13, 0.32, 0.12]];
        let crowns = greens.map(|tint| tinted(model, "leaves", leaves, tint)).to_vec();
        let coats = [
            [0.7, 0.08, 0.06],
            [0.1, 0.2, 0.5],
            [0.8, 0.8, 0.78],
            [0.12, 0.12, 0.13],
            [0.4, 0.45, 0.42],
        ];
        let car_paint = coats.map(|coat| model.material(Material::lambert("paint", coat))).to_vec();
        let mut plain =
            |name: &str, colour: [f32; 3]| model.material(Material::lambert(name, colour));
        let bark = plain("bark", [0.22, 0.15, 0.09]);
        let concrete = plain("concrete", [0.62, 0.6, 0.57]);
        let glass = plain("glass", [0.08, 0.1, 0.12]);
        let rubber = plain("rubber", [0.03; 3]);
        let globe = plain("globe", [0.9, 0.9, 0.82]);
        let steel = Material::lambert("pole", [0.2, 0.22, 0.2]);
        let pole = model.material(Material { thin: true, ..steel });
        Self {
            grass,
            street,
            street_across,
            crossing,
            paving,
            park,
            houses,
            flats,
            tiles,
            gravel,
            crowns,
            bark,
            concrete,
            car_paint,
            glass,
            rubber,
            pole,
            globe,
        }
    }
}

/// The colour of a wall over the unit square of an image, which covers 3 m or a bay.
type WallPattern = fn(DVec2) -> Vec3;

fn tinted(model: &mut Model, name: &str, image: TextureRef, tint: [f32; 3]) -> u32 {
    let base: Vec4 = Vec3::from(tint).extend(1.0);
    model.material(Material {
        name: name.into(),
        base,
        base_texture: Some(image),
        ..Material::default()
    })
}

/// The walls of houses, of plaster and of brick, and those of flats.
fn all_walls(model: &mut Model) -> (Vec<Walls>, Vec<Walls>) {
    let plaster: WallPattern = |at| marbled(at, 8, 74, [0.72; 3], [0.88; 3]);
    let brick: WallPattern = |at| {
        let row = (at.y * 40.0).floor();
        let joint = (at.y * 40.0).fract() < 0.16 || (at.x * 14.0 + 0.5 * row).fract() < 0.06;
        let tone = marbled(at, 32, 75, [0.55; 3], [1.0; 3]);
        if joint { Vec3::splat(0.75) } else { tone * Vec3::new(0.85, 0.75, 0.7) }
    };
    let plastered = walls(model, plaster, 0.46);
    let bricks = walls(model, brick, 0.42);
    let panels: WallPattern = |at| {
        let joint = (at * 4.0).fract().min_element() < 0.02;
        marbled(at, 16, 76, [0.7; 3], [0.85; 3]) * if joint { 0.6 } else { 1.0 }
    };
    let panels = walls(model, panels, 0.66);
    let plaster_tints = [
        [0.95, 0.9, 0.78],
        [0.9, 0.72, 0.42],
        [0.85, 0.55, 0.45],
        [0.62, 0.75, 0.82],
        [0.7, 0.8, 0.6],
    ];
    let mut houses: Vec<Walls> =
        plaster_tints.iter().map(|&tint| tinted_walls(model, plastered, tint)).collect();
    houses.extend(
        [[0.75, 0.34, 0.24], [0.8, 0.6, 0.4]].map(|tint| tinted_walls(model, bricks, tint)),
    );
    let flats = [[0.9, 0.88, 0.84], [0.8, 0.7, 0.6], [0.65, 0.72, 0.78]];
    (houses, flats.map(|tint| tinted_walls(model, panels, tint)).to_vec())
}

/// Roof tiles in rows.
fn roofs(model: &mut Model) -> Vec<u32> {
    let tiles = model.paint(256, |at| {
        let row = (at.y * 10.0).floor();
        let (down, along) = ((at.y * 10.0).fract(), (at.x * 12.0 + 0.5 * row).fract());
        let round = 0.75 + 0.25 * (along * std::f64::consts::PI).sin();
        let shade = round * if down > 0.86 { 0.45 } else { 0.85 + 0.15 * down };
        marbled(at, 24, 77, [0.62; 3], [1.0; 3]) * shade as f32
    });
    let roofs = [[0.72, 0.25, 0.14], [0.5, 0.17, 0.12], [0.25, 0.26, 0.3], [0.42, 0.3, 0.2]];
    roofs.map(|tint| tinted(model, "roof", tiles, tint)).to_vec()
}

/// Images of a ground floor, of upper floors with windows, and of a plain wall.
fn walls(model: &mut Model, pattern: WallPattern, width: f64) -> [TextureRef; 3] {
    [
        model.paint(256, |at| bay(dvec2(at.x, 0.0), at, pattern, width, true)),
        model.paint(512, |at| bay(at, (at * f64::from(BAYS)).fract(), pattern, width, false)),
        model.paint(256, pattern),
    ]
}

fn tinted_walls(model: &mut Model, images: [TextureRef; 3], tint: [f32; 3]) -> Walls {
    let [ground, upper, plain] = images.map(|image| tinted(model, "wall", image, tint));
    Walls { ground, upper, plain }
}

/// The colour of a bay of a wall with a door, or with a window of `width` times the bay's width. `at`, the
/// position in the image, selects the bay by x and the floor by y (0 in the image of a ground floor). Only y of
/// `within` is used: the position within the floor.
fn bay(at: DVec2, within: DVec2, pattern: WallPattern, width: f64, with_door: bool) -> Vec3 {
    let (number, floor) = ((at.x * f64::from(BAYS)).floor(), (at.y * f64::from(BAYS)).floor());
    let within = dvec2((at.x * f64::from(BAYS)).fract(), within.y);
    let is_door = with_door && number as u32 == 1;
    let (top, bottom) = if is_door { (0.22, 1.0) } else { (0.2, 0.74) };
    let half = if is_door { 0.2 } else { 0.5 * width };
    let aside = (within.x - 0.5).abs();
    let wall = pattern(within);
    if aside > half || within.y < top || within.y > bottom {
        let sill = !is_door && aside < half + 0.03 && (bottom..bottom + 0.05).contains(&within.y);
        let base = with_door && within.y > 0.9;
        return if sill {
            Vec3::splat(0.95)
        } else if base {
            0.6 * wall
        } else {
            wall
        };
    }
    if is_door {
        let panel = aside < 0.13 && (within.y * 5.0).fract() > 0.2;
        return if panel { Vec3::new(0.25, 0.13, 0.07) } else { Vec3::new(0.4, 0.22, 0.12) };
    }
    let frame = 0.025;
    let edge = aside > half - frame || within.y < top + frame || within.y > bottom - frame;
    if edge || aside < 0.012 {
        return Vec3::splat(0.92);
    }
    // Each window has its own curtains, or none.
    let mut draws = Draws::new(80, &[number as u64, floor as u64, u64::from(with_door)]);
    let (drawn, tone) = (draws.unit64(), 0.4 + 0.5 * draws.unit());
    let glass = Vec3::new(0.1, 0.13, 0.17) * (0.7 + 0.8 * (bottom - within.y) as f32);
    let curtain = aside > half * (0.4 + drawn);
    let fold = 0.85 + 0.15 * (within.x * 160.0).sin() as f32;
    if curtain { Vec3::new(tone, 0.95 * tone, 0.85 * tone) * fold } else { glass }
}

/// 10 m of a street along y, with pavements left and right.
fn street(at: DVec2) -> Vec3 {
    let side = 11.0 * (at.x - 0.5);
    let along = 10.0 * at.y;
    match side.abs() {
        d if d > 3.65 => {
            let joint = along.fract() < 0.06 || (d - 3.65).fract() < 0.06;
            marbled(at, 24, 81, [0.4, 0.39, 0.37], [0.56, 0.55, 0.52])
                * if joint { 0.6 } else { 1.0 }
        }
        d if d > 3.5 => Vec3::splat(0.66),
        d if d < 0.07 && along < 5.0 => Vec3::splat(0.8),
        _ => asphalt(at),
    }
}

/// A crossing with pavement at its corners and zebra crossings on all sides.
fn crossing(at: DVec2) -> Vec3 {
    let out = (11.0 * (at - 0.5)).abs();
    if out.min_element() > 3.5 {
        return marbled(at, 24, 82, [0.4, 0.39, 0.37], [0.56, 0.55, 0.52]);
    }
    let (ahead, aside) = (out.max_element(), out.min_element());
    let zebra = (3.7..5.2).contains(&ahead) && aside < 3.2 && (aside + 0.25).rem_euclid(1.0) < 0.5;
    if zebra { Vec3::splat(0.78) } else { asphalt(at) }
}

fn asphalt(at: DVec2) -> Vec3 {
    let patch = 0.85 + 0.3 * noise(at, 3, 2, 83) as f32;
    marbled(at, 64, 84, [0.1; 3], [0.24, 0.24, 0.25]) * patch
}
