//! Shading of surfaces by Lambert's law and glTF's metallic-roughness model (glTF 2.0 specification, appendix
//! B), lit by the scene's lights and the sky.
//!
//! The file exceeds 400 lines because lights, materials and reflection all work on the point being shaded.

use std::f32::consts::PI;
use std::sync::OnceLock;

use glam::{DVec3, Vec2, Vec3, Vec4, Vec4Swizzles};

use crate::intersect::Intersection;
use crate::mesh::{AlphaMode, Light, LightKind, Material, Model, Reflection};
use crate::packet::{LANES, has};
use crate::random::{
    Draws, cosine_hemisphere, frame, ggx_distribution, ggx_visible_normal, stratum,
};
use crate::sky::Sky;
use crate::surface::{LocalHit, LocalRay, Surface};
use crate::texture::TextureRef;

/// Smallest alpha of GGX: the peak of a highlight would otherwise be too narrow for single precision.
const MIN_ALPHA: f32 = 1e-3;
/// Distance above the surface at which secondary rays start, and in front of a light at which they end: 20 ulps
/// of local coordinates, as the hit point is rounded in each coordinate and along the ray.
const LIFT: f32 = 2.5e-3;
/// Reflectance of a dielectric at normal incidence.
const DIELECTRIC: f32 = 0.04;

/// The method of computing the light from the sky and from other surfaces.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ambient {
    /// The sky is never occluded; computed in closed form without secondary rays.
    Open,
    /// Occlusion of the sky is sampled with this number of rays per pixel.
    Occlusion(u32),
    /// As `Occlusion`, but the occluding surfaces reflect the light that falls on them directly (one bounce).
    Bounce(u32),
}

/// The light of a scene.
pub(crate) struct Lighting {
    /// The lights, in local coordinates.
    lights: Vec<Light>,
    pub(crate) sky: Sky,
    pub(crate) ambient: Ambient,
    pub(crate) shadows: bool,
    /// Subsamples along each side of a pixel.
    pub(crate) grid: u32,
}

/// A surface point with its material evaluated.
pub(crate) struct Point<'a> {
    position: Vec3,
    /// Geometric normal, towards the viewer.
    geometric: Vec3,
    /// Shading normal.
    shading: Vec3,
    material: &'a Material,
    base: Vec3,
    metallic: f32,
    alpha_ggx: f32,
    roughness: f32,
    emitted: Vec3,
}

/// A pixel's random numbers, and triangles to test first, which speeds up rays but does not change results.
pub(crate) struct Sampling {
    pub(crate) draws: Draws,
    /// Slot (place in the tree's leaves) of a triangle hit by a camera ray.
    pub(crate) hit_hint: Option<u32>,
    /// Slot of the last triangle that occluded a light.
    pub(crate) occluder_hint: Option<u32>,
}

/// A point seen by one of a pixel's subsamples.
pub(crate) struct VisiblePoint<'a> {
    /// Index of the subsample.
    pub(crate) index: u32,
    pub(crate) point: Point<'a>,
    /// Direction towards the viewer, unit length.
    pub(crate) view: Vec3,
}

impl Lighting {
    pub(crate) fn new(
        lights: &[Light],
        surface: &Surface,
        sky: Sky,
        (ambient, shadows, grid): (Ambient, bool, u32),
    ) -> Self {
        let place = |p: DVec3| surface.local_from_world(p);
        let scale = surface.scale();
        let lights = lights.iter().map(|light| {
            // Intensity falls with the square of distance, and distances are in local units.
            let spread = (scale * scale) as f32;
            let (kind, gain) = match light.kind {
                LightKind::Directional { .. } => (light.kind, 1.0),
                LightKind::Point { position } => {
                    (LightKind::Point { position: place(position) }, spread)
                }
                LightKind::Spot { position, direction, cos_inner, cos_outer } => {
                    let position = place(position);
                    (LightKind::Spot { position, direction, cos_inner, cos_outer }, spread)
                }
                LightKind::Area { corner, u, v } => {
                    (LightKind::Area { corner: place(corner), u: u * scale, v: v * scale }, 1.0)
                }
            };
            Light { kind, intensity: light.intensity * gain, range: light.range * scale }
        });
        Self { lights: lights.collect(), sky, ambient, shadows, grid: grid.max(1) }
    }

    /// Radiance of at most [`LANES`] points of a pixel towards the viewer. For each light, the points share one
    /// packet of shadow rays.
    pub(crate) fn radiance(
        &self,
        shaded: &ShadedSurface<'_>,
        points: &[VisiblePoint<'_>],
        sampling: &mut Sampling,
    ) -> [Vec3; LANES] {
        let mut total = [Vec3::ZERO; LANES];
        for (total, VisiblePoint { point, .. }) in total.iter_mut().zip(points) {
            *total = if point.is_unlit() { point.base } else { point.emitted };
        }
        for light in &self.lights {
            let mut rays = [LocalRay::NONE; LANES];
            // For each ray, the index of its point and the light it adds if it is not occluded.
            let mut contributions = [(0, Vec3::ZERO); LANES];
            let mut count = 0;
            for (number, VisiblePoint { index, point, view }) in points.iter().enumerate() {
                if point.is_unlit() {
                    continue;
                }
                let u = || stratum(*index, self.grid, sampling.draws.square());
                let Some((to_light, distance, irradiance)) =
                    incident_light(light, point.position, u)
                else {
                    continue;
                };
                if point.geometric.dot(to_light) <= 0.0 {
                    continue;
                }
                let reflected = point.reflected(*view, to_light) * irradiance;
                if reflected.max_element() > 0.0 {
                    rays[count] = shadow_ray(point, to_light, distance);
                    contributions[count] = (number, reflected);
                    count += 1;
                }
            }
            let occluded = self.occluded(shaded, &rays[..count], sampling);
            for (lane, &(number, reflected)) in contributions.iter().enumerate().take(count) {
                if !has(occluded, lane) {
                    total[number] += reflected;
                }
            }
        }
        for (total, seen) in total.iter_mut().zip(points) {
            if !seen.point.is_unlit() {
                *total += self.ambient(shaded, seen, sampling);
            }
        }
        total
    }

    /// The rays that do not reach their light, as bits.
    fn occluded(
        &self,
        shaded: &ShadedSurface<'_>,
        rays: &[LocalRay],
        sampling: &mut Sampling,
    ) -> u32 {
        if !self.shadows {
            return 0;
        }
        let solid = |slot, at: &Intersection| shaded.is_solid(slot, at);
        shaded.surface.occluded_each(rays, &mut sampling.occluder_hint, solid)
    }

    /// Radiance of the light from the sky and from other surfaces that a point reflects.
    fn ambient(
        &self,
        shaded: &ShadedSurface<'_>,
        seen: &VisiblePoint<'_>,
        sampling: &mut Sampling,
    ) -> Vec3 {
        let VisiblePoint { index, ref point, view } = *seen;
        let shiny = point.material.reflection == Reflection::MetalRough;
        let diffuse_colour = point.diffuse_colour();
        let rays = match self.ambient {
            Ambient::Open => {
                let diffuse = diffuse_colour * self.sky.irradiance(point.shading) / PI;
                return if shiny { diffuse + self.specular_sky(point, view) } else { diffuse };
            }
            Ambient::Occlusion(rays) | Ambient::Bounce(rays) => rays,
        };
        let bounce = matches!(self.ambient, Ambient::Bounce(_));
        let count = rays.div_ceil(self.grid * self.grid).max(1);
        let (tangent, bitangent) = frame(point.shading);
        let mut sum = Vec3::ZERO;
        for _ in 0..count {
            let u = stratum(index, self.grid, sampling.draws.square());
            let d = cosine_hemisphere(u);
            let direction = d.x * tangent + d.y * bitangent + d.z * point.shading;
            if point.geometric.dot(direction) > 0.0 {
                sum += self.incoming(shaded, point, direction, bounce, sampling);
            }
        }
        let diffuse = diffuse_colour * sum / count as f32;
        if !shiny {
            return diffuse;
        }
        if !bounce {
            return diffuse + self.specular_sky(point, view);
        }
        diffuse + self.specular_bounce(shaded, seen, sampling)
    }

    /// Radiance from a direction: that of the sky or, with `bounce`, of the directly lit surface in front of it.
    /// Without `bounce`, surfaces are black.
    fn incoming(
        &self,
        shaded: &ShadedSurface<'_>,
        point: &Point<'_>,
        direction: Vec3,
        bounce: bool,
        sampling: &mut Sampling,
    ) -> Vec3 {
        let ray = secondary_ray(point, direction, f32::MAX);
        let solid = |slot, at: &Intersection| shaded.is_solid(slot, at);
        if !bounce {
            let occluded = shaded.surface.occluder(&ray, solid).is_some();
            return if occluded { Vec3::ZERO } else { self.sky.radiance(direction) };
        }
        let Some(hit) = shaded.surface.closest(&ray, None, None, solid) else {
            return self.sky.radiance(direction);
        };
        let (lit, _) = Point::read(shaded, &ray, &hit, 0.0);
        if lit.is_unlit() {
            return lit.base;
        }
        let emitted = if lit.material.is_light { Vec3::ZERO } else { lit.emitted };
        let mut total = emitted + lit.diffuse_colour() * self.sky.irradiance(lit.shading) / PI;
        for light in &self.lights {
            let u = || sampling.draws.square();
            let Some((to_light, distance, irradiance)) = incident_light(light, lit.position, u)
            else {
                continue;
            };
            let cos = lit.shading.dot(to_light);
            if cos > 0.0
                && lit.geometric.dot(to_light) > 0.0
                && self.occluded(shaded, &[shadow_ray(&lit, to_light, distance)], sampling) == 0
            {
                total += lit.diffuse_colour() / PI * cos * irradiance;
            }
        }
        total
    }

    /// The sky's specular reflection without rays: the radiance of the blurred sky times the albedo.
    fn specular_sky(&self, point: &Point<'_>, view: Vec3) -> Vec3 {
        let cos = point.shading.dot(view).max(0.0);
        let (scale, bias) = directional_albedo(cos, point.roughness);
        let albedo = point.f0() * scale + Vec3::splat(bias);
        let direction = 2.0 * point.shading.dot(view) * point.shading - view;
        albedo * self.sky.blurred(direction, point.roughness)
    }

    /// The specular reflection of sky and surfaces, from one sampled direction.
    fn specular_bounce(
        &self,
        shaded: &ShadedSurface<'_>,
        seen: &VisiblePoint<'_>,
        sampling: &mut Sampling,
    ) -> Vec3 {
        let VisiblePoint { index, ref point, view } = *seen;
        let (tangent, bitangent) = frame(point.shading);
        let cos = view.dot(point.shading).max(1e-4);
        let local = Vec3::new(view.dot(tangent), view.dot(bitangent), cos).normalize();
        let u = stratum(index, self.grid, sampling.draws.square());
        let half = ggx_visible_normal(local, point.alpha_ggx, u);
        let out = 2.0 * local.dot(half) * half - local;
        let direction = out.x * tangent + out.y * bitangent + out.z * point.shading;
        if out.z <= 0.0 || point.geometric.dot(direction) <= 0.0 {
            return Vec3::ZERO;
        }
        let weight = fresnel(point.f0(), local.dot(half))
            * shadowing_after_masking(local.z, out.z, point.alpha_ggx);
        weight * self.incoming(shaded, point, direction, true, sampling)
    }
}

impl<'a> Point<'a> {
    /// The hit point with its material evaluated, and its alpha, which is 0 where the material is masked out.
    /// `width` is the width of the ray's cone at the point, in local units.
    pub(crate) fn read(
        shaded: &ShadedSurface<'a>,
        ray: &LocalRay,
        hit: &LocalHit,
        width: f32,
    ) -> (Self, f32) {
        let (at, material) = shaded.locate(hit.slot, &hit.at, width);
        let model = shaded.model;
        let [a, b, c] = at.corners;
        let Intersection { v, w, front, .. } = hit.at;
        let face = (b - a).cross(c - a);
        let side = if front { 1.0 } else { -1.0 };
        // A triangle without area has no normal.
        let geometric = face.normalize_or(-ray.direction * side) * side;
        let base = at.base(material);
        let alpha = at.alpha(material, base.w);

        let smooth = at.interpolated(&model.normals).unwrap_or(Vec3::ZERO);
        let mut shading = smooth.normalize_or_zero() * side;
        if shading.dot(geometric) <= 0.0 {
            shading = geometric;
        }
        if let Some(texture) = &material.normal_texture {
            let texel = at.texel(Some(texture)).xyz();
            shading = at.normal_mapped(shading, side, texel, texture, material.normal_scale);
            // A normal on the other side of the surface would be lit from behind.
            if shading.dot(geometric) <= 0.0 {
                shading = geometric;
            }
        }
        let (rough, metal) = (&material.roughness_texture, &material.metallic_texture);
        let rough_texel = at.texel(rough.as_ref());
        let metal_texel = if metal == rough { rough_texel } else { at.texel(metal.as_ref()) };
        let roughness = (material.roughness * rough_texel.y).clamp(0.0, 1.0);
        let emitted = material.emissive * at.texel(material.emissive_texture.as_ref()).xyz();
        let point = Self {
            position: a + v * (b - a) + w * (c - a),
            geometric,
            shading,
            material,
            base: base.xyz(),
            metallic: (material.metallic * metal_texel.z).clamp(0.0, 1.0),
            alpha_ggx: (roughness * roughness).max(MIN_ALPHA),
            roughness,
            emitted,
        };
        (point, alpha)
    }

    fn is_unlit(&self) -> bool {
        self.material.reflection == Reflection::Unlit
    }

    fn diffuse_colour(&self) -> Vec3 {
        match self.material.reflection {
            Reflection::MetalRough => self.base * (1.0 - self.metallic),
            Reflection::Lambert | Reflection::Unlit => self.base,
        }
    }

    fn f0(&self) -> Vec3 {
        Vec3::splat(DIELECTRIC).lerp(self.base, self.metallic)
    }

    /// Reflected radiance per irradiance from a direction, including the cosine.
    fn reflected(&self, view: Vec3, to_light: Vec3) -> Vec3 {
        let cos_light = self.shading.dot(to_light);
        if cos_light <= 0.0 {
            return Vec3::ZERO;
        }
        let diffuse = self.diffuse_colour() / PI;
        if self.material.reflection == Reflection::Lambert {
            return diffuse * cos_light;
        }
        let cos_view = self.shading.dot(view).max(1e-4);
        let half = (view + to_light).normalize_or(self.shading);
        let f = fresnel(self.f0(), view.dot(half).max(0.0));
        let d = ggx_distribution(self.shading.dot(half).clamp(0.0, 1.0), self.alpha_ggx);
        let specular = f * d * visibility(cos_view, cos_light, self.alpha_ggx);
        ((Vec3::ONE - f) * diffuse + specular) * cos_light
    }
}

/// Geometry with its materials.
pub(crate) struct ShadedSurface<'a> {
    pub(crate) surface: &'a Surface,
    pub(crate) model: &'a Model,
    /// By slot; empty if all triangles are opaque and double-sided.
    pub(crate) flags: &'a [TriangleFlags],
}

/// Properties of a triangle that decide whether a ray hits it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct TriangleFlags {
    /// True if the back is invisible.
    pub(crate) one_sided: bool,
    /// True if alpha may be below one.
    pub(crate) see_through: bool,
}

impl TriangleFlags {
    /// The flags of all triangles by slot; empty if none is set.
    pub(crate) fn all(surface: &Surface, model: &Model) -> Vec<Self> {
        let flags = |slot: usize| {
            let triangle = surface.triangle_of(slot as u32) as usize;
            let material = &model.materials[model.triangle_materials[triangle] as usize];
            Self {
                one_sided: !material.double_sided,
                see_through: material.alpha != AlphaMode::Opaque,
            }
        };
        let all: Vec<Self> = (0..surface.triangles.len()).map(flags).collect();
        if all.iter().all(|&t| t == Self::default()) { Vec::new() } else { all }
    }
}

impl<'a> ShadedSurface<'a> {
    /// True if camera rays can hit this side of the triangle.
    #[inline]
    pub(crate) fn is_visible(&self, slot: u32, at: &Intersection) -> bool {
        at.front || !self.flags.get(slot as usize).is_some_and(|t| t.one_sided)
    }

    /// True if a triangle is opaque here for shadows and sampled light, from either side: its alpha is at least
    /// one half.
    pub(crate) fn is_solid(&self, slot: u32, at: &Intersection) -> bool {
        if !self.flags.get(slot as usize).is_some_and(|t| t.see_through) {
            return true;
        }
        let (at, material) = self.locate(slot, at, 0.0);
        at.alpha(material, at.base(material).w) >= 0.5
    }

    fn locate(
        &self,
        slot: u32,
        at: &Intersection,
        width: f32,
    ) -> (TrianglePoint<'a>, &'a Material) {
        let model = self.model;
        let triangle = self.surface.triangle_of(slot) as usize;
        let indices = model.triangles[triangle].map(|i| i as usize);
        let material = &model.materials[model.triangle_materials[triangle] as usize];
        let weights = [1.0 - at.v - at.w, at.v, at.w];
        let corners = self.surface.triangles[slot as usize];
        (TrianglePoint { model, indices, weights, corners, width }, material)
    }
}

/// A point of a triangle, for interpolating vertex attributes and sampling textures.
struct TrianglePoint<'a> {
    model: &'a Model,
    indices: [usize; 3],
    weights: [f32; 3],
    corners: [Vec3; 3],
    width: f32,
}

impl TrianglePoint<'_> {
    fn base(&self, material: &Material) -> Vec4 {
        let tint = self.interpolated(&self.model.colours).unwrap_or(Vec4::ONE);
        material.base * self.texel(material.base_texture.as_ref()) * tint
    }

    /// The surface's alpha; `base` is the alpha of the base colour.
    fn alpha(&self, material: &Material, base: f32) -> f32 {
        if material.alpha == AlphaMode::Opaque {
            return 1.0;
        }
        let opacity = (base * self.texel(material.alpha_texture.as_ref()).x).clamp(0.0, 1.0);
        match material.alpha {
            AlphaMode::Mask(cutoff) => f32::from(u8::from(opacity >= cutoff)),
            AlphaMode::Opaque | AlphaMode::Blend => opacity,
        }
    }

    fn interpolated<T>(&self, values: &[T]) -> Option<T>
    where
        T: Copy + std::ops::Mul<f32, Output = T> + std::ops::Add<Output = T>,
    {
        let [a, b, c] = self.indices.map(|i| values.get(i).copied());
        Some(a? * self.weights[0] + b? * self.weights[1] + c? * self.weights[2])
    }

    fn texel(&self, texture: Option<&TextureRef>) -> Vec4 {
        let Some(texture) = texture else {
            return Vec4::ONE;
        };
        let uvs = &self.model.uvs[texture.uv_set.min(1)];
        let uv = texture.transformed(self.interpolated(uvs).unwrap_or(Vec2::ZERO));
        let image = &self.model.textures[texture.texture as usize];
        let mut footprint = 0.0;
        if self.width > 0.0 && uvs.len() > self.indices[0].max(self.indices[1]).max(self.indices[2])
        {
            let [a, b, c] = self.indices.map(|i| uvs[i]);
            let uv_area = (b - a).perp_dot(c - a).abs() * texture.area_scale();
            let [a, b, c] = self.corners;
            let area = (b - a).cross(c - a).length();
            footprint = if area > 0.0 { self.width * (uv_area / area).sqrt() } else { 0.0 };
        }
        image.sample(uv, &texture.sampler, footprint)
    }

    /// The shading normal after normal mapping.
    fn normal_mapped(
        &self,
        normal: Vec3,
        side: f32,
        texel: Vec3,
        texture: &TextureRef,
        scale: f32,
    ) -> Vec3 {
        let bump = (2.0 * texel - Vec3::ONE) * Vec3::new(scale, scale, 1.0);
        let given = self.interpolated(&self.model.tangents).filter(|t| t.w != 0.0);
        let (tangent, handedness) = match given {
            Some(t) => (t.xyz(), t.w.signum()),
            None => match self.tangent_of_uvs(texture) {
                Some(found) => found,
                None => return normal,
            },
        };
        let tangent = (tangent - normal * normal.dot(tangent)).normalize_or_zero();
        // Seen from behind, the normal is flipped but the texture is not.
        let bitangent = normal.cross(tangent) * handedness * side;
        (bump.x * tangent + bump.y * bitangent + bump.z * normal).normalize_or(normal)
    }

    /// The direction of increasing u, and the handedness, 1 or −1; `None` if texture coordinates do not define them.
    fn tangent_of_uvs(&self, texture: &TextureRef) -> Option<(Vec3, f32)> {
        let uvs = &self.model.uvs[texture.uv_set.min(1)];
        let [ta, tb, tc] = self.indices.map(|i| uvs.get(i).map(|&uv| texture.transformed(uv)));
        let (d1, d2) = (tb? - ta?, tc? - ta?);
        let [a, b, c] = self.corners;
        let (e1, e2) = (b - a, c - a);
        let determinant = d1.perp_dot(d2);
        if determinant == 0.0 {
            return None;
        }
        let tangent = (e1 * d2.y - e2 * d1.y) / determinant;
        // In glTF v points down but the bitangent points up in the image, hence the sign.
        Some((tangent, -determinant.signum()))
    }
}

/// Direction to a light, distance, and irradiance of a surface that faces it; `u` draws the point of an area
/// light. `None` if the light does not reach this position.
fn incident_light(
    light: &Light,
    target: Vec3,
    u: impl FnOnce() -> Vec2,
) -> Option<(Vec3, f32, Vec3)> {
    let from_point = |position: DVec3| {
        let offset = position.as_vec3() - target;
        let distance = offset.length();
        let in_range = distance > 0.0 && f64::from(distance) <= light.range;
        in_range.then(|| (offset / distance, distance))
    };
    match light.kind {
        LightKind::Directional { direction } => {
            Some((-direction.as_vec3(), f32::MAX, light.intensity))
        }
        LightKind::Point { position } => {
            let (to, distance) = from_point(position)?;
            Some((to, distance, light.intensity * attenuation(distance, light.range)))
        }
        LightKind::Spot { position, direction, cos_inner, cos_outer } => {
            let (to, distance) = from_point(position)?;
            let cos = -to.dot(direction.as_vec3());
            let share = ((cos - cos_outer) / (cos_inner - cos_outer).max(1e-3)).clamp(0.0, 1.0);
            let irradiance = light.intensity * (attenuation(distance, light.range) * share * share);
            (share > 0.0).then_some((to, distance, irradiance))
        }
        LightKind::Area { corner, u: side_u, v: side_v } => {
            let u = u();
            let (side_u, side_v) = (side_u.as_vec3(), side_v.as_vec3());
            let (to, distance) = from_point(corner + (u.x * side_u + u.y * side_v).as_dvec3())?;
            let area = side_u.cross(side_v);
            let projected = -to.dot(area);
            let solid_angle = projected / (distance * distance);
            (projected > 0.0).then_some((to, distance, light.intensity * solid_angle))
        }
    }
}

/// 1 / distance², cut off smoothly at the range (KHR_lights_punctual, recommended form).
fn attenuation(distance: f32, range: f64) -> f32 {
    let inverse_square = 1.0 / (distance * distance);
    if !range.is_finite() {
        return inverse_square;
    }
    let share = f64::from(distance) / range;
    inverse_square * (1.0 - share.powi(4)).clamp(0.0, 1.0) as f32
}

/// The ray from a point to just in front of a light.
fn shadow_ray(point: &Point<'_>, to_light: Vec3, distance: f32) -> LocalRay {
    secondary_ray(point, to_light, (distance - 2.0 * LIFT).max(0.0))
}

fn secondary_ray(point: &Point<'_>, direction: Vec3, tmax: f32) -> LocalRay {
    LocalRay { origin: point.position + point.geometric * LIFT, direction, tmin: 0.0, tmax }
}

/// Schlick's approximation.
fn fresnel(f0: Vec3, cos: f32) -> Vec3 {
    let grazing = (1.0 - cos).clamp(0.0, 1.0);
    f0 + (Vec3::ONE - f0) * (grazing * grazing) * (grazing * grazing) * grazing
}

/// Number of steps of the table of directional albedo along each axis.
const STEPS: usize = 16;

/// The directional albedo of GGX as a factor (scale) on the reflectance at normal incidence and an offset (bias)
/// (Karis, "Real Shading in Unreal Engine 4", 2013). It is interpolated in a table that is computed once by sampling
/// visible normals.
fn directional_albedo(cos: f32, roughness: f32) -> (f32, f32) {
    static TABLE: OnceLock<Vec<(f32, f32)>> = OnceLock::new();
    let table = TABLE.get_or_init(|| {
        let entry = |i: usize| {
            let cos = ((i % (STEPS + 1)) as f32 / STEPS as f32).max(0.01);
            let roughness = (i / (STEPS + 1)) as f32 / STEPS as f32;
            integrated_albedo(cos, (roughness * roughness).max(MIN_ALPHA))
        };
        (0..(STEPS + 1) * (STEPS + 1)).map(entry).collect()
    });
    let place = |value: f32| {
        let at = value.clamp(0.0, 1.0) * STEPS as f32;
        let low = (at as usize).min(STEPS - 1);
        (low, at - low as f32)
    };
    let ((x, dx), (y, dy)) = (place(cos), place(roughness));
    let mix = |a: (f32, f32), b: (f32, f32), t: f32| (a.0 + t * (b.0 - a.0), a.1 + t * (b.1 - a.1));
    let row = |y: usize| {
        let first = y * (STEPS + 1) + x;
        mix(table[first], table[first + 1], dx)
    };
    mix(row(y), row(y + 1), dy)
}

fn integrated_albedo(cos: f32, alpha: f32) -> (f32, f32) {
    const GRID: u32 = 16;
    let view = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
    let (mut scale, mut bias) = (0.0, 0.0);
    for i in 0..GRID * GRID {
        let half = ggx_visible_normal(view, alpha, stratum(i, GRID, Vec2::splat(0.5)));
        let seen = view.dot(half).max(0.0);
        let out = 2.0 * seen * half - view;
        if out.z > 0.0 {
            let weight = shadowing_after_masking(cos, out.z, alpha);
            let grazing = (1.0 - seen).powi(5);
            scale += weight * (1.0 - grazing);
            bias += weight * grazing;
        }
    }
    let count = (GRID * GRID) as f32;
    (scale / count, bias / count)
}

/// Height-correlated Smith shadowing and masking, divided by 4 · `cos_view` · `cos_light` (Heitz, JCGT 2014).
fn visibility(cos_view: f32, cos_light: f32, alpha: f32) -> f32 {
    let a2 = alpha * alpha;
    let v = cos_light * (cos_view * cos_view * (1.0 - a2) + a2).sqrt();
    let l = cos_view * (cos_light * cos_light * (1.0 - a2) + a2).sqrt();
    0.5 / (v + l)
}

/// G2 / G1: the weight of a direction that was sampled by reflection at a visible normal.
pub(crate) fn shadowing_after_masking(cos_view: f32, cos_out: f32, alpha: f32) -> f32 {
    let a2 = alpha * alpha;
    let lambda = |c: f32| 0.5 * ((1.0 + a2 * (1.0 / (c * c) - 1.0).max(0.0)).sqrt() - 1.0);
    let (v, o) = (lambda(cos_view), lambda(cos_out));
    (1.0 + v) / (1.0 + v + o)
}
