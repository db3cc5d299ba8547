//! Tests of frames against values worked out by hand.

use std::f32::consts::PI;
use std::sync::Arc;

use glam::{DQuat, Vec4};

use super::*;
use crate::mesh::{AlphaMode, Light, LightKind, Material, Reflection};
use crate::panorama::Panorama;
use crate::rig::RigKind;
use crate::shade::Ambient;
use crate::sky::Sky;
use crate::{Options, Scene, Source};

/// Renders a model as seen by a camera.
fn render(model: &Model, camera: &Camera, sky: Sky, ambient: Ambient) -> Frame {
    let surface = Surface::new(model).expect("triangles");
    let flags = TriangleFlags::all(&surface, model);
    let lighting = Lighting::new(&model.lights, &surface, sky, (ambient, true, 4));
    let (surface, flags, lighting) = (&surface, &flags[..], &lighting);
    Tracer { surface, model, flags, lighting, exposure: 1.0, seed: 1 }.render(camera, 0, None)
}

fn above(height: f64) -> Camera {
    Camera::looking(DVec3::new(0.2, height, 0.1), DVec3::ZERO, DVec3::Z, 0.8, (48, 40))
}

fn floor(material: Material) -> Model {
    let mut model = Model::default();
    let material = model.material(material);
    model.quad(DVec3::new(-9.0, 0.0, 9.0), 18.0 * DVec3::X, -18.0 * DVec3::Z, material);
    model
}

fn sun(towards: DVec3, irradiance: f32) -> Light {
    let kind = LightKind::Directional { direction: -towards.normalize() };
    Light { kind, intensity: Vec3::splat(irradiance), range: f64::INFINITY }
}

#[test]
fn a_lit_plane_has_the_expected_colour_and_depth() {
    let mut model = floor(Material::lambert("grey", [0.5, 0.25, 0.1]));
    let towards = DVec3::new(1.0, 2.0, 0.5);
    model.lights.push(sun(towards, 2.0));
    let camera = above(3.0);
    let sky = Sky::Gradient { zenith: [0.3; 3], ground: [0.1; 3], up: [0.0, 1.0, 0.0] };
    let frame = render(&model, &camera, sky, Ambient::Open);
    // Irradiance of the sun, and of the sky: pi · (0.2 + 2/3 · 0.1).
    let irradiance = 2.0 * towards.normalize().y as f32 + PI * (0.2 + 0.2 / 3.0);
    let expected = [0.5, 0.25, 0.1].map(|albedo| encode(albedo / PI * irradiance));
    for (i, pixel) in frame.rgba.chunks_exact(4).enumerate() {
        for channel in 0..3 {
            assert!(pixel[channel].abs_diff(expected[channel]) <= 1, "{pixel:?}, not {expected:?}");
        }
        assert_eq!(pixel[3], 255);
        let at = DVec2::new((i % 48) as f64 + 0.5, (i / 48) as f64 + 0.5);
        let depth = -camera.centre.y / camera.direction(at).y;
        assert!((f64::from(frame.depth[i]) / depth - 1.0).abs() < 1e-6);
        assert_eq!(frame.normals[i], [0.0, 1.0, 0.0]);
    }
}

#[test]
fn lights_have_the_expected_irradiance() {
    let at = DVec3::new(0.0, 2.0, 0.0);
    let down = DVec3::NEG_Y;
    // Irradiance straight below: I / d², cut off beyond the range and outside the cone.
    let light = |kind, intensity, range| Light { kind, intensity: Vec3::splat(intensity), range };
    let point = |range| light(LightKind::Point { position: at }, 3.0, range);
    let spot = |direction: DVec3| {
        let (direction, cos_inner, cos_outer) = (direction.normalize(), 0.98, 0.9);
        light(LightKind::Spot { position: at, direction, cos_inner, cos_outer }, 3.0, f64::INFINITY)
    };
    let (u, v) = (0.02 * DVec3::X, 0.02 * DVec3::Z);
    let corner = at - DVec3::new(0.01, 0.0, 0.01);
    let area = light(LightKind::Area { corner, u, v }, 3.0 / 0.0004, f64::INFINITY);
    let away = Light { kind: LightKind::Area { corner: at, u: v, v: u }, ..area };
    let cases = [
        (point(f64::INFINITY), 0.75),
        (point(1.9), 0.0),
        (point(2.5), 0.75 * (1.0 - 0.8_f32.powi(4))),
        (spot(down), 0.75),
        (spot(DVec3::X), 0.0),
        (area, 0.75),
        (away, 0.0),
    ];
    for (light, irradiance) in cases {
        let mut model = floor(Material::lambert("white", [1.0; 3]));
        model.lights.push(light);
        // A narrow view of the point below the light, from the side.
        let camera =
            Camera::looking(DVec3::new(1.0, 1.0, 0.0), DVec3::ZERO, DVec3::Y, 0.01, (8, 8));
        let frame = render(&model, &camera, Sky::uniform(0.0), Ambient::Open);
        let expected = encode(irradiance / PI);
        let found = frame.rgba[0];
        assert!(found.abs_diff(expected) <= 1, "{light:?}: {found}, not {expected}");
    }
}

#[test]
fn a_sphere_has_the_expected_depth_and_normals() {
    let mut model = Model::default();
    let material = model.material(Material::default());
    let (centre, radius) = (DVec3::new(0.5, -0.3, 0.2), 1.3);
    model.sphere(centre, radius, 6, material);
    let camera = Camera::looking(DVec3::new(3.0, 2.0, 4.0), centre, DVec3::Y, 0.7, (64, 64));
    let frame = render(&model, &camera, Sky::uniform(1.0), Ambient::Open);
    let mut seen = 0;
    for i in 0..64 * 64 {
        let d = camera.direction(DVec2::new((i % 64) as f64 + 0.5, (i / 64) as f64 + 0.5));
        let o = camera.centre - centre;
        let (a, b, c) = (d.dot(d), o.dot(d), o.dot(o) - radius * radius);
        let root = b * b - a * c;
        let normal = Vec3::from(frame.normals[i]);
        if root <= 0.0 {
            assert_eq!((frame.depth[i], normal, frame.triangles[i]), (0.0, Vec3::ZERO, u32::MAX));
            continue;
        }
        let t = (-b - root.sqrt()) / a;
        let exact = (o + t * d) / radius;
        // Corners lie on the sphere, so faces are inside it by at most the sagitta of an edge of 1.1 / 64
        // radians, 3.7e-5 radii; more along grazing rays.
        let grazing = -exact.dot(d.normalize());
        if grazing > 0.1 {
            let beyond = (f64::from(frame.depth[i]) - t) * d.length() * grazing;
            assert!((-1e-6..1e-4).contains(&beyond), "{beyond} at pixel {i}");
            assert!(normal.as_dvec3().dot(exact) > 0.9998, "normal at pixel {i}");
            seen += 1;
        }
    }
    assert!(seen > 1000, "{seen} pixels");
}

#[test]
fn the_white_furnace_is_white() {
    let camera = Camera::looking(DVec3::new(2.0, 1.0, 3.0), DVec3::ZERO, DVec3::Y, 0.5, (24, 24));
    let furnace = |material: Material, ambient| {
        let mut model = Model::default();
        let material = model.material(material);
        model.sphere(DVec3::ZERO, 0.5, 4, material);
        let frame = render(&model, &camera, Sky::uniform(0.5), ambient);
        let inside: Vec<f32> = frame
            .rgba
            .chunks_exact(4)
            .filter(|pixel| pixel[3] == 255)
            .map(|pixel| f32::from(pixel[0]))
            .collect();
        assert!(inside.len() > 30);
        inside.iter().sum::<f32>() / inside.len() as f32
    };
    let white = f32::from(encode(0.5));
    let lambert = Material::lambert("white", [1.0; 3]);
    for ambient in [Ambient::Open, Ambient::Occlusion(64), Ambient::Bounce(64)] {
        let mean = furnace(lambert.clone(), ambient);
        assert!((mean - white).abs() < 0.6, "{ambient:?}: {mean}, not {white}");
    }
    // GGX loses the light that bounces within its microsurface, more for rougher surfaces, and never gains any.
    let metal = |roughness| Material {
        reflection: Reflection::MetalRough,
        metallic: 1.0,
        roughness,
        ..Material::default()
    };
    for (roughness, min) in [(0.1, 0.97), (0.3, 0.93), (1.0, 0.35)] {
        for ambient in [Ambient::Open, Ambient::Bounce(64)] {
            let mean = furnace(metal(roughness), ambient);
            let linear = crate::texture::linear_from_srgb(f64::from(mean) / 255.0) / 0.5;
            assert!(linear < 1.01 && linear > min, "{roughness}, {ambient:?}: {linear}");
        }
    }
}

#[test]
fn only_occluders_cast_shadows() {
    let mut model = floor(Material::lambert("white", [1.0; 3]));
    model.lights.push(sun(DVec3::Y, PI));
    let camera = Camera::looking(DVec3::new(3.0, 0.5, 0.0), DVec3::ZERO, DVec3::Y, 0.02, (8, 8));
    let sky = || Sky::uniform(0.1);
    let lit = render(&model, &camera, sky(), Ambient::Open).rgba[0];
    assert_eq!(lit, encode(1.1));
    // A lid above the floor casts a shadow.
    let lid = model.material(Material::default());
    model.quad(DVec3::new(-1.0, 1.0, -1.0), 2.0 * DVec3::X, 2.0 * DVec3::Z, lid);
    assert_eq!(render(&model, &camera, sky(), Ambient::Open).rgba[0], encode(0.1));
    let hidden = render(&model, &camera, sky(), Ambient::Occlusion(256)).rgba[0];
    assert!(hidden < encode(0.1), "{hidden}");
    // Light passes through holes in a mask and through surfaces of low opacity.
    for alpha in [AlphaMode::Mask(0.5), AlphaMode::Blend] {
        model.materials[lid as usize].base = Vec4::new(1.0, 1.0, 1.0, 0.3);
        model.materials[lid as usize].alpha = alpha;
        assert_eq!(render(&model, &camera, sky(), Ambient::Open).rgba[0], lit, "{alpha:?}");
    }
}

#[test]
fn depth_is_that_of_the_first_surface_of_at_least_half_opacity() {
    let camera = above(5.0);
    let (floor_depth, lid_depth) = (5.0, 4.0);
    let middle = (20 * 48 + 24) as usize;
    for (alpha, opacity, one_sided, expected) in [
        (AlphaMode::Opaque, 0.1, false, lid_depth),
        (AlphaMode::Blend, 0.6, false, lid_depth),
        (AlphaMode::Blend, 0.4, false, floor_depth),
        (AlphaMode::Mask(0.3), 0.4, false, lid_depth),
        (AlphaMode::Mask(0.5), 0.4, false, floor_depth),
        (AlphaMode::Opaque, 1.0, true, floor_depth),
    ] {
        let mut model = floor(Material::lambert("white", [1.0; 3]));
        let lid = model.material(Material {
            base: Vec4::new(0.0, 0.0, 0.0, opacity),
            alpha,
            double_sided: !one_sided,
            ..Material::default()
        });
        // Its front faces down.
        model.quad(DVec3::new(-1.0, 1.0, -1.0), 2.0 * DVec3::X, 2.0 * DVec3::Z, lid);
        let frame = render(&model, &camera, Sky::uniform(1.0), Ambient::Open);
        let found = f64::from(frame.depth[middle]);
        let exact = -expected / camera.direction(DVec2::new(24.5, 20.5)).y;
        assert!((found - exact).abs() < 1e-5, "{alpha:?} {opacity}: {found}, not {exact}");
        if alpha == AlphaMode::Blend {
            // Black over white.
            let value = frame.rgba[4 * middle];
            assert!(value.abs_diff(encode(1.0 - opacity)) <= 1, "{value}");
        }
    }
}

#[test]
fn images_are_the_same_at_any_number_of_threads() {
    for name in ["spheres", "cornell"] {
        let options =
            Options { size: Some((40, 33)), train: Some(3), test: Some(1), ..Options::default() };
        let scene = Scene::prepare(&Source::Preset(name.into()), &options).expect("preset");
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool");
            pool.install(|| scene.render(1))
        };
        let one = with(1);
        assert!(one == with(2) && one == with(5), "{name}");
        assert!(one != scene.render(2));
    }
}

#[test]
fn cameras_are_outside_of_solids() {
    // The cameras are inside a room, a large part of which is filled by a block.
    let mut model = Model::default();
    let material = model.material(Material::default());
    model.cuboid(DVec3::ZERO, -DVec3::splat(2.0), DQuat::IDENTITY, material);
    model.cuboid(DVec3::X * 0.9, DVec3::new(0.4, 1.2, 1.2), DQuat::IDENTITY, material);
    let surface = Surface::new(&model).expect("triangles");
    let rig = crate::rig::Rig {
        kind: RigKind::Inside,
        radius: 0.45,
        clearance: 0.02,
        ..Default::default()
    };
    let (train, test) = rig.cameras(&surface, &[]).expect("places");
    for camera in train.iter().chain(&test) {
        let p = camera.centre;
        let within = (p.x - 0.9).abs() < 0.4 && p.y.abs() < 1.2 && p.z.abs() < 1.2;
        assert!(!within && p.abs().max_element() < 2.0, "{p}");
        assert!(surface.nearest(p).distance >= 0.02 * surface.diagonal());
    }
}

#[test]
fn image_skies_agree_with_gradients_and_sampling_agrees_with_the_closed_form() {
    let mut model = floor(Material::lambert("grey", [0.5; 3]));
    let shiny = Material {
        reflection: Reflection::MetalRough,
        metallic: 1.0,
        roughness: 0.4,
        ..Material::lambert("metal", [0.8; 3])
    };
    let shiny = model.material(shiny);
    model.cuboid(DVec3::new(0.0, 0.3, 0.0), DVec3::splat(0.3), DQuat::IDENTITY, shiny);
    let camera = above(3.0);
    // A uniform sky, as a gradient and as an image.
    let image = |width: usize, radiance: &dyn Fn(usize) -> Vec3| {
        let pixels = (0..width * width / 2).map(radiance).collect();
        Sky::Image(Arc::new(Panorama::new("sky".into(), width, pixels)))
    };
    for ambient in [Ambient::Open, Ambient::Occlusion(64), Ambient::Bounce(64)] {
        let plain = render(&model, &camera, Sky::uniform(0.6), ambient);
        let by_image = render(&model, &camera, image(32, &|_| Vec3::splat(0.6)), ambient);
        for (a, b) in plain.rgba.iter().zip(&by_image.rgba) {
            assert!(a.abs_diff(*b) <= 1, "{ambient:?}: {a} and {b}");
        }
    }
    // For a sky with one bright side over an empty floor, sampling agrees with the closed form on average.
    let model = floor(Material::lambert("grey", [0.5; 3]));
    let side = image(64, &|i| if i % 64 < 32 { Vec3::splat(2.0) } else { Vec3::ZERO });
    let mean = |ambient| {
        let frame = render(&model, &camera, side.clone(), ambient);
        let sum: f64 = frame.rgba.chunks_exact(4).map(|p| f64::from(p[0])).sum();
        sum / (frame.rgba.len() / 4) as f64
    };
    let (formula, sampled) = (mean(Ambient::Open), mean(Ambient::Occlusion(64)));
    assert!((formula - sampled).abs() < 1.0, "{formula} and {sampled}");
}

#[test]
fn a_scene_that_no_view_shows_is_an_error() {
    let folder = tempfile::tempdir().expect("folder");
    let options = |rig| Options {
        rig,
        size: Some((16, 16)),
        train: Some(3),
        test: Some(1),
        grid: 1,
        ..Options::default()
    };
    let check = |file: &str, rig, is_seen: bool| match (
        Scene::prepare(&Source::File(folder.path().join(file)), &options(rig)),
        is_seen,
    ) {
        (Ok(_), true) => {}
        (Err(error), false) => {
            let error = error.to_string();
            assert!(error.contains(file) && error.contains("shows a surface"), "{error}");
        }
        (Ok(_), false) => panic!("{file} is seen"),
        (Err(error), true) => panic!("{error}"),
    };
    let write =
        |name: &str, text: String| std::fs::write(folder.path().join(name), text).expect("write");
    write("a.obj", "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n".to_owned());
    // A faint surface is visible, a fully transparent one is not.
    for (opacity, is_seen) in [("1", true), ("0.25", true), ("0", false)] {
        write("a.mtl", format!("newmtl m\nd {opacity}\n"));
        check("a.obj", None, is_seen);
    }
    let (ahead, back) = ([0, 0, 0, 1], [0, 1, 0, 0]);
    let corners: [f32; 9] = [-1.0, -1.0, 0.0, 1.0, -1.0, 0.0, 0.0, 1.0, 0.0];
    let bytes: Vec<u8> = corners.iter().flat_map(|value| value.to_le_bytes()).collect();
    let uri = base64::Engine::encode(&base64::engine::general_purpose::STANDARD, bytes);
    for (mesh, camera, is_seen) in
        [(ahead, ahead, true), (ahead, back, false), (back, ahead, false)]
    {
        let text = serde_json::json!({
            "asset": { "version": "2.0" },
            "scenes": [{ "nodes": [0, 1] }],
            "nodes": [
                { "mesh": 0, "translation": [0, 0, -5], "rotation": mesh },
                { "camera": 0, "rotation": camera },
            ],
            "cameras": [{ "type": "perspective", "perspective": { "yfov": 0.8, "znear": 0.1 } }],
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
            "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3" }],
            "bufferViews": [{ "buffer": 0, "byteLength": 36 }],
            "buffers": [{ "byteLength": 36, "uri": format!("data:;base64,{uri}") }],
        });
        write("b.gltf", text.to_string());
        check("b.gltf", Some(RigKind::File), is_seen);
    }
}
