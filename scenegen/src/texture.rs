//! Textures: colour spaces, wrap modes, filters and texture transforms.
//!
//! Texels are filtered in linear light. Minification uses mipmaps, so that a fine texture has the same colour
//! from every distance; otherwise a trainer would learn the noise of a shimmering ground truth.

use std::sync::OnceLock;

use glam::{Vec2, Vec4};

/// The continuation of a texture beyond the unit square of its coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wrap {
    /// The texels of the edge, continued.
    Clamp,
    /// The image repeated.
    Repeat,
    /// The image repeated, every other copy mirrored.
    Mirror,
}

/// Wrap modes and filters of a texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sampler {
    /// Horizontal wrap mode.
    pub wrap_u: Wrap,
    /// Vertical wrap mode.
    pub wrap_v: Wrap,
    /// If true, magnified texels are not interpolated.
    pub nearest: bool,
    /// If true, mipmaps are used for minification.
    pub mipmaps: bool,
}

impl Default for Sampler {
    fn default() -> Self {
        Self { wrap_u: Wrap::Repeat, wrap_v: Wrap::Repeat, nearest: false, mipmaps: true }
    }
}

/// A material's use of a texture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TextureRef {
    /// Index of the texture in the model.
    pub texture: u32,
    /// Set of texture coordinates: 0 or 1.
    pub uv_set: usize,
    /// Wrap modes and filters.
    pub sampler: Sampler,
    /// Rows of the matrix that transforms texture coordinates (u, v, 1) (`KHR_texture_transform`).
    pub transform: [[f32; 3]; 2],
}

impl TextureRef {
    /// A reference to a texture that uses the first set of coordinates, repeats the image and filters it.
    pub fn new(texture: u32) -> Self {
        let transform = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        Self { texture, uv_set: 0, sampler: Sampler::default(), transform }
    }

    pub(crate) fn transformed(&self, uv: Vec2) -> Vec2 {
        let row = |r: [f32; 3]| r[0] * uv.x + r[1] * uv.y + r[2];
        Vec2::new(row(self.transform[0]), row(self.transform[1]))
    }

    /// The factor by which the transform scales areas.
    pub(crate) fn area_scale(&self) -> f32 {
        let [[a, b, _], [c, d, _]] = self.transform;
        (a * d - b * c).abs()
    }
}

/// A decoded image with its mipmaps.
#[derive(Debug, Clone)]
pub struct Texture {
    /// True if colours are sRGB-encoded; alpha never is.
    pub srgb: bool,
    levels: Vec<Level>,
}

#[derive(Debug, Clone)]
struct Level {
    width: u32,
    height: u32,
    /// RGBA. Shape: `[height, width, 4]`.
    texels: Vec<u8>,
}

impl Texture {
    /// A texture of `width` x `height` RGBA texels, top row first. `texels` has four bytes per texel; missing
    /// ones are white.
    pub fn new(width: u32, height: u32, mut texels: Vec<u8>, srgb: bool) -> Self {
        let (width, height) = (width.max(1), height.max(1));
        texels.resize(4 * width as usize * height as usize, 255);
        let mut levels = vec![Level { width, height, texels }];
        while let Some(last) = levels.last()
            && (last.width > 1 || last.height > 1)
        {
            let smaller = last.halved(srgb);
            levels.push(smaller);
        }
        Self { srgb, levels }
    }

    /// Width and height `[texels]`.
    pub fn size(&self) -> (u32, u32) {
        (self.levels[0].width, self.levels[0].height)
    }

    /// The linear RGBA value at `uv`, averaged over about `footprint` of the texture's width. (0, 0) is the top
    /// left corner.
    pub fn sample(&self, uv: Vec2, sampler: &Sampler, footprint: f32) -> Vec4 {
        let uv = Vec2::new(wrapped(uv.x, sampler.wrap_u), wrapped(uv.y, sampler.wrap_v));
        let tables = LinearTables::new(self.srgb);
        let first = &self.levels[0];
        let texels = footprint * ((first.width * first.height) as f32).sqrt();
        let level = if sampler.mipmaps { texels.log2() } else { 0.0 };
        // NaN selects the first level.
        if level.is_nan() || level <= 0.0 {
            let nearest = sampler.nearest;
            return if nearest {
                first.nearest(uv, tables)
            } else {
                first.linear(uv, sampler, tables)
            };
        }
        let last = self.levels.len() - 1;
        let level = level.min(last as f32);
        let lower = level as usize;
        let share = level - lower as f32;
        let a = self.levels[lower].linear(uv, sampler, tables);
        if share == 0.0 || lower == last {
            return a;
        }
        a.lerp(self.levels[lower + 1].linear(uv, sampler, tables), share)
    }
}

impl Level {
    #[inline]
    fn texel(&self, x: u32, y: u32, LinearTables { colour, alpha }: LinearTables) -> Vec4 {
        let at = 4 * (y as usize * self.width as usize + x as usize);
        let [r, g, b, a] = [0, 1, 2, 3].map(|i| usize::from(self.texels[at + i]));
        Vec4::new(colour[r], colour[g], colour[b], alpha[a])
    }

    fn nearest(&self, uv: Vec2, tables: LinearTables) -> Vec4 {
        let x = ((uv.x * self.width as f32) as u32).min(self.width - 1);
        let y = ((uv.y * self.height as f32) as u32).min(self.height - 1);
        self.texel(x, y, tables)
    }

    #[inline]
    fn linear(&self, uv: Vec2, sampler: &Sampler, tables: LinearTables) -> Vec4 {
        let (x0, x1, fx) = neighbours(uv.x, self.width, sampler.wrap_u);
        let (y0, y1, fy) = neighbours(uv.y, self.height, sampler.wrap_v);
        let upper = self.texel(x0, y0, tables).lerp(self.texel(x1, y0, tables), fx);
        let lower = self.texel(x0, y1, tables).lerp(self.texel(x1, y1, tables), fx);
        upper.lerp(lower, fy)
    }

    /// The image at half its size, averaged in linear light.
    fn halved(&self, srgb: bool) -> Self {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let tables = LinearTables::new(srgb);
        let mut texels = Vec::with_capacity(4 * width as usize * height as usize);
        for y in 0..height {
            for x in 0..width {
                // The range of source texels: two, or three if the size is odd.
                let (x0, x1) = range(x, width, self.width);
                let (y0, y1) = range(y, height, self.height);
                let mut sum = Vec4::ZERO;
                for v in y0..y1 {
                    for u in x0..x1 {
                        sum += self.texel(u, v, tables);
                    }
                }
                let mean = sum / ((x1 - x0) * (y1 - y0)) as f32;
                let code = |v: f32| if srgb { encode(v) } else { to_u8(v) };
                texels.extend([code(mean.x), code(mean.y), code(mean.z), to_u8(mean.w)]);
            }
        }
        Self { width, height, texels }
    }
}

/// The `i`-th of `count` nearly equal parts of `0..total`: start and end.
fn range(i: u32, count: u32, total: u32) -> (u32, u32) {
    let (i, count, total) = (u64::from(i), u64::from(count), u64::from(total));
    ((i * total / count) as u32, ((i + 1) * total / count) as u32)
}

/// Maps a coordinate into `[0, 1]` by the wrap mode. A non-finite coordinate becomes 0.
fn wrapped(x: f32, wrap: Wrap) -> f32 {
    let x = if x.is_finite() { x } else { 0.0 };
    match wrap {
        Wrap::Clamp => x.clamp(0.0, 1.0),
        Wrap::Repeat => x - x.floor(),
        Wrap::Mirror => {
            let x = x - 2.0 * (0.5 * x).floor();
            if x > 1.0 { 2.0 - x } else { x }
        }
    }
}

/// The two texels on either side of a coordinate in `[0, 1]`, and the weight of the second.
fn neighbours(u: f32, size: u32, wrap: Wrap) -> (u32, u32, f32) {
    let x = u * size as f32 - 0.5;
    let first = if x < 0.0 { -1 } else { x as i64 };
    let last = i64::from(size) - 1;
    // At most one of the two texels lies beyond an edge, by one; its mirror image is the texel at the edge.
    let at = |i: i64, repeated: i64| match wrap {
        _ if (0..=last).contains(&i) => i as u32,
        Wrap::Repeat => repeated as u32,
        Wrap::Clamp | Wrap::Mirror => i.clamp(0, last) as u32,
    };
    (at(first, last), at(first + 1, 0), x - first as f32)
}

fn to_u8(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// The linear value of an sRGB value in `[0, 1]` (IEC 61966-2-1).
pub fn linear_from_srgb(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// The sRGB value of a linear value in `[0, 1]` (IEC 61966-2-1).
pub fn srgb_from_linear(v: f64) -> f64 {
    if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

/// Tables from a texel's bytes to linear colour and alpha.
#[derive(Debug, Clone, Copy)]
struct LinearTables {
    colour: &'static [f32; 256],
    alpha: &'static [f32; 256],
}

impl LinearTables {
    fn new(srgb: bool) -> Self {
        static TABLES: OnceLock<[[f32; 256]; 2]> = OnceLock::new();
        let [plain, decoded] = TABLES.get_or_init(|| {
            let decoded = |i: usize| linear_from_srgb(i as f64 / 255.0) as f32;
            [std::array::from_fn(|i| i as f32 / 255.0), std::array::from_fn(decoded)]
        });
        Self { colour: if srgb { decoded } else { plain }, alpha: plain }
    }
}

/// The sRGB byte nearest to a linear value, which is clamped to `[0, 1]`. Rounds half up in the encoded space;
/// NaN gives 0.
pub fn encode(v: f32) -> u8 {
    (srgb_from_linear(f64::from(v.clamp(0.0, 1.0))) * 255.0 + 0.5) as u8
}
