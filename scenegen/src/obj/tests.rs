//! Tests of the OBJ reader: files that `tobj` alone would misread, smoothing groups, materials.

#![allow(clippy::float_cmp, reason = "exact values")]

use std::io::Cursor;

use glam::Vec4;

use super::materials::Map;
use super::statements::Statement;
use super::*;
use crate::mesh::{AlphaMode, Reflection};
use crate::texture::{TextureRef, linear_from_srgb};

/// Loads an OBJ file with other files in its folder.
fn loaded(obj: &str, files: &[(&str, &[u8])]) -> Result<Model, Error> {
    let folder = tempfile::tempdir().expect("folder");
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).expect("write");
    }
    let path = folder.path().join("test.obj");
    std::fs::write(&path, obj).expect("write");
    load(&path)
}

/// The vertices of two squares that meet at a right angle along the y axis.
const ROOF: &str = "v 0 0 0\nv 0 1 0\nv 1 0 0\nv 1 1 0\nv 0 0 -1\nv 0 1 -1\n";

#[test]
fn smoothing_groups_share_normals_and_other_faces_are_flat() {
    let normals = |text: &str| {
        let model = loaded(&format!("{ROOF}{text}"), &[]).expect("a roof");
        let at = |i: u32| model.normals.get(i as usize).copied().unwrap_or_default();
        // By triangle and corner: position and normal.
        let corners = model.triangles.iter().flatten();
        corners.map(|&i| (model.positions[i as usize], at(i))).collect::<Vec<_>>()
    };
    let (z, x) = (Vec3::Z, Vec3::NEG_X);
    let edge = (z + x).normalize();
    for (text, at_edge, beside) in [
        ("s 1\nf 1 3 4 2\nf 5 1 2 6\n", [edge, edge], [z, x]),
        ("s 1\nf 1 3 4 2\ns 2\nf 5 1 2 6\n", [z, x], [z, x]),
        ("f 1 3 4 2\nf 5 1 2 6\n", [Vec3::ZERO; 2], [Vec3::ZERO; 2]),
        ("s 1\ns off\nf 1 3 4 2\ns 0\nf 5 1 2 6\n", [Vec3::ZERO; 2], [Vec3::ZERO; 2]),
        // A face's own normal takes precedence over the group's.
        (
            "vn 0 1 0\ns 1\nf 1//1 3//1 4//1 2//1\ns off\nf 5 1 2 6\n",
            [Vec3::Y, Vec3::ZERO],
            [Vec3::Y, Vec3::ZERO],
        ),
    ] {
        for (i, (position, normal)) in normals(text).into_iter().enumerate() {
            let face = i / 6;
            let is_edge = position.x == 0.0 && position.z == 0.0;
            let expected = if is_edge { at_edge[face] } else { beside[face] };
            assert!(normal.distance(expected) < 1e-6, "{text}: {position} has {normal}");
        }
    }
    let error = loaded(&format!("{ROOF}s five\nf 1 2 3\n"), &[]).expect_err("no group");
    assert!(error.to_string().contains("line 7") && error.to_string().contains("five"));
}

#[test]
fn maps_of_roughness_and_metalness_are_read() {
    let grey = |value: u8| {
        let mut bytes = Cursor::new(Vec::new());
        let image = image::GrayImage::from_pixel(2, 2, image::Luma([value]));
        image.write_to(&mut bytes, image::ImageFormat::Png).expect("PNG");
        bytes.into_inner()
    };
    let (rough, metal) = (grey(51), grey(204));
    let load = |library: &str| {
        let obj = format!("mtllib a.mtl\n{ROOF}vt 0 0\nusemtl m\nf 1/1 3/1 4/1\n");
        let files: [(&str, &[u8]); 3] =
            [("a.mtl", library.as_bytes()), ("r.png", &rough), ("m.png", &metal)];
        loaded(&obj, &files).expect("a triangle")
    };
    let model = load("newmtl m\nmap_Pr r.png\nmap_Pm m.png\nPr 0.5\nbump r.png\n");
    let material = &model.materials[0];
    assert_eq!(material.reflection, Reflection::MetalRough);
    assert_eq!((material.roughness, material.metallic), (0.5, 1.0));
    let value = |texture: &Option<TextureRef>| {
        let texture = texture.as_ref().expect("a texture");
        let image = &model.textures[texture.texture as usize];
        image.sample(Vec2::splat(0.5), &texture.sampler, 0.0)
    };
    // Shading reads roughness from green and metalness from blue.
    assert!((value(&material.roughness_texture).y - 0.2).abs() < 1e-6);
    assert!((value(&material.metallic_texture).z - 0.8).abs() < 1e-6);
    assert!(model.notes.iter().any(|note| note.contains("bump")), "{:?}", model.notes);
    // Without a map the number applies; by default, the metalness is 0.
    let model = load("newmtl m\nmap_Pr r.png\n");
    let material = &model.materials[0];
    assert_eq!((material.roughness, material.metallic), (1.0, 0.0));
    assert!(material.metallic_texture.is_none() && model.notes.is_empty());
    let model = load("newmtl m\nPm 0.25\nmap_Pm m.png\n");
    assert_eq!(model.materials[0].metallic, 0.25);
}

#[test]
fn texture_options_are_separated_from_the_name() {
    let path = Path::new("a.mtl");
    let read = |text| Map::read(Statement { path, line: 1, key: "map_Kd", text });
    let map = read("-o 0.5 0.25 -s 2 3 1 -clamp on -bm 0.3 my file.png").expect("map");
    assert_eq!(map.file, "my file.png");
    assert_eq!((map.offset, map.scale), (Vec2::new(0.5, 0.25), Vec2::new(2.0, 3.0)));
    assert!(map.clamp);
    assert!(map.range == [0.0, 1.0] && !map.is_turbulent);
    let map = read("-mm 0.2 0.5 -t 0 0 0.1 a.png").expect("map");
    assert!(map.range == [0.2, 0.5] && map.is_turbulent && map.file == "a.png");
    let map = read("-t 0 0 0 -mm 0.25 a.png").expect("map");
    assert!(map.range == [0.25, 1.0] && !map.is_turbulent);
    assert!(read("-s 1 1 1").is_none());
    assert!(read("").is_none());
}

#[test]
fn corners_without_coordinates_get_placeholders() {
    let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.25 0.5\nvn 0 0 2\n\
                f 1/1/1 2/1 3//1\nf 1 2 3\nf 3/1 2/1 1/1\n";
    let model = loaded(text, &[]).expect("three triangles");
    let (uv, normal) = (Vec2::new(0.25, 0.5), Vec3::Z);
    let corners = model.triangles.iter().flatten().map(|&i| i as usize);
    let found: Vec<_> = corners.map(|i| (model.uvs[0][i], model.normals[i])).collect();
    let (no_uv, no_normal) = (Vec2::ZERO, Vec3::ZERO);
    assert_eq!(found[..3], [(uv, normal), (uv, no_normal), (no_uv, normal)]);
    assert_eq!(found[3..6], [(no_uv, no_normal); 3]);
    assert_eq!(found[6..], [(uv, no_normal); 3]);
}

#[test]
fn vertices_without_a_valid_colour_are_white() {
    // The second vertex has a colour that is not finite; the colour of the third follows a weight.
    let text = "v 0 0 0\nv 1 0 0 0.5 -1 nan\nv 0 1 0 1 0.25 -1 0\nf 3 2 1\n";
    let model = loaded(text, &[]).expect("a triangle");
    let colours: Vec<_> = model.triangles[0].map(|i| model.colours[i as usize]).to_vec();
    let quarter = linear_from_srgb(0.25) as f32;
    assert_eq!(colours, [Vec4::new(quarter, 0.0, 0.0, 1.0), Vec4::ONE, Vec4::ONE]);
}

/// A PNG image of one grey value and one alpha value.
fn png(grey: u8, alpha: u8) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let image = image::GrayAlphaImage::from_pixel(2, 2, image::LumaA([grey, alpha]));
    image.write_to(&mut bytes, image::ImageFormat::Png).expect("PNG");
    bytes.into_inner()
}

/// A triangle with material `m` of this library, which may use the images `t.png` and `a.png`. The numbers `colour`
/// follow each vertex's position.
fn painted(colour: &str, library: &str) -> Model {
    let obj = format!(
        "mtllib a.mtl\nv 0 0 0 {colour}\nv 1 0 0 {colour}\nv 0 1 0 {colour}\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
    );
    let (t, a) = (png(128, 51), png(204, 255));
    let files: [(&str, &[u8]); 3] = [("a.mtl", library.as_bytes()), ("t.png", &t), ("a.png", &a)];
    loaded(&obj, &files).expect("a triangle")
}

#[test]
fn vertex_colours_are_srgb_from_0_to_255_or_0_to_1() {
    let grey = linear_from_srgb(128.0 / 255.0) as f32;
    for (colour, expected) in [
        ("128 128 128", grey),
        ("127.5 127.5 127.5", linear_from_srgb(0.5) as f32),
        ("0.5019608 0.5019608 0.5019608", grey),
        // A rounding error above 1 does not mean a range up to 255.
        ("1.000001 1.000001 1.000001", 1.0),
        ("1 1 1", 1.0),
    ] {
        for library in ["newmtl m\n", "newmtl m\nKd 0 0 0\n", "newmtl m\nKd 1 1 1\n", ""] {
            let model = painted(colour, library);
            let base = model.materials[model.triangle_materials[0] as usize].base.truncate();
            let shown = base * model.colours[0].truncate();
            assert!((shown - expected).abs().max_element() < 1e-6, "{colour}, {library}: {shown}");
        }
    }
    let error = loaded("v 0 0 0 1 1 256\n", &[]).expect_err("no colour").to_string();
    assert!(error.contains("line 1") && error.contains("256"), "{error}");
    // Without vertex colours, the material keeps the default grey or its `Kd`.
    assert_eq!(painted("", "").materials[0].base.x, GREY);
    assert_eq!(painted("", "newmtl m\nKd 0 0 0\n").materials[0].base.x, 0.0);
}

#[test]
fn a_factor_of_zero_beside_a_map_shows_the_map() {
    for (factor, expected) in [("Kd 0 0 0", 1.0), ("", 1.0), ("Kd 0.5 0.5 0.5", 0.5)] {
        for maps in ["map_Kd t.png", "map_kd t.png", "MAP_KD -s 2 2 2 t.png"] {
            let model = painted("", &format!("newmtl m\n{factor}\n{maps}\n"));
            assert_eq!(model.materials[0].base, Vec4::new(expected, expected, expected, 1.0));
            assert!(model.materials[0].base_texture.is_some());
        }
    }
    let library = "newmtl m\nKe 0 0 0\nmap_Ke t.png\nPr 0\nmap_Pr t.png\nPm 0\nmap_Pm t.png\nd 0\nmap_d a.png\n";
    let material = &painted("", library).materials[0];
    assert_eq!((material.emissive, material.roughness), (Vec3::ONE, 1.0));
    assert_eq!((material.metallic, material.base.w), (1.0, 1.0));
    let material = &painted("", "newmtl m\nKe 0 0 0\nPr 0\nPm 0\nd 0\n").materials[0];
    assert_eq!((material.emissive, material.roughness), (Vec3::ZERO, 0.0));
    assert_eq!((material.metallic, material.base.w), (0.0, 0.0));
}

#[test]
fn opacity_follows_the_conventions_of_exporters() {
    for (library, expected) in [
        ("newmtl m\nTr 1.000000\nmap_Kd t.png\n", 1.0),
        ("newmtl m\nTr 1\n", 1.0),
        ("newmtl m\nTr 0.25\n", 0.75),
        ("newmtl m\nTr 0\n", 1.0),
        ("newmtl m\nTr 1\nd 1\n", 1.0),
        ("newmtl m\nd 1\nTr 1\n", 1.0),
        ("newmtl m\nd 0.25\nTr 0\n", 0.25),
        ("newmtl m\nTr 0.75\nd 0.75\n", 0.75),
        ("newmtl m\nd 0\n", 0.0),
        ("# Converted by Meshlab Group\nnewmtl m\nTr 1.0\nmap_Kd t.png\n", 1.0),
        ("# Converted by Meshlab Group\nnewmtl m\nTr 0.25\n", 0.25),
    ] {
        let model = painted("", library);
        let material = &model.materials[0];
        assert_eq!(material.base.w, expected, "{library}");
        assert_eq!(material.alpha == AlphaMode::Blend, expected < 1.0, "{library}");
        let is_noted = model.notes.iter().any(|note| note.contains("Tr 1"));
        assert_eq!(is_noted, !library.contains("d 1") && library.starts_with("newmtl m\nTr 1"));
    }
    // An image with an alpha channel may be the map of colour and of opacity.
    let alpha = |library| {
        let model = painted("", library);
        let material = &model.materials[0];
        assert_eq!(material.alpha, AlphaMode::Blend);
        let texel = |texture: Option<TextureRef>| {
            let texture = texture?;
            let image = &model.textures[texture.texture as usize];
            Some(image.sample(Vec2::splat(0.5), &texture.sampler, 0.0))
        };
        texel(material.base_texture).map_or(1.0, |texel| texel.w)
            * texel(material.alpha_texture).map_or(1.0, |texel| texel.x)
    };
    assert!((alpha("newmtl m\nmap_Kd t.png\nmap_d t.png\n") - 0.2).abs() < 1e-6);
    assert!((alpha("newmtl m\nmap_d a.png\n") - 0.8).abs() < 1e-6);
}

/// The stored values are changed, before they are decoded as sRGB; values outside of 0 to 1 are clamped.
#[test]
fn base_and_gain_of_a_map_are_applied() {
    let shown = |options: &str| {
        let library = format!("newmtl m\nKd 1 1 1\nmap_Kd {options}t.png\nmap_Ke t.png\n");
        let model = painted("", &library);
        let texel = |texture: Option<TextureRef>| {
            let texture = texture.expect("a texture");
            let image = &model.textures[texture.texture as usize];
            image.sample(Vec2::splat(0.5), &texture.sampler, 0.0)
        };
        let material = &model.materials[0];
        assert!(model.notes.is_empty(), "{:?}", model.notes);
        // Another use of the image has its own range; both uses keep the alpha channel.
        let (base, emissive) = (texel(material.base_texture), texel(material.emissive_texture));
        assert!((emissive.x - linear_from_srgb(128.0 / 255.0) as f32).abs() < 1e-6);
        assert!((base.w - 0.2).abs() < 1e-6 && (emissive.w - 0.2).abs() < 1e-6);
        base.x
    };
    // 128 of 255 becomes 51 + 64, 51 + 128, and more than 255 or less than 0.
    for (options, value) in [
        ("", 128.0),
        ("-mm 0 1 ", 128.0),
        ("-mm 0.2 0.5 ", 115.0),
        ("-mm 0.2 ", 179.0),
        ("-mm 0.9 1 ", 255.0),
        ("-mm 0.2 -1 ", 0.0),
    ] {
        let expected = linear_from_srgb(value / 255.0) as f32;
        assert!((shown(options) - expected).abs() < 1e-6, "{options}: {}", shown(options));
    }
}

#[test]
fn options_without_effect_are_noted() {
    for (library, words) in [
        ("map_Kd -t 0 0 0 t.png\n", &[][..]),
        ("map_Kd -t 0.1 0 0 t.png\n", &["material m", "-t of map_kd"]),
        ("map_Ke -t 1 t.png\n", &["material m", "-t of map_ke"]),
        ("map_Kd t.png\nmap_d -mm 0.5 t.png\n", &["material m", "-mm of map_d"]),
        ("map_Kd t.png\nmap_d -mm 0.5 a.png\n", &[]),
    ] {
        let notes = painted("", &format!("newmtl m\n{library}")).notes;
        assert_eq!(notes.len(), usize::from(!words.is_empty()), "{library}: {notes:?}");
        assert!(words.iter().all(|word| notes[0].contains(word)), "{library}: {notes:?}");
    }
}

#[test]
fn byte_order_marks_are_skipped() {
    let (t, mark) = (png(128, 255), "\u{feff}");
    let library = format!("{mark}newmtl m\nmap_Kd t.png\n");
    let files: [(&str, &[u8]); 2] = [("a.mtl", library.as_bytes()), ("t.png", &t)];
    for first in ["v 0 0 0\nmtllib a.mtl".to_owned(), "mtllib a.mtl\nv 0 0 0".to_owned()] {
        let obj = format!("{mark}{first}\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n");
        let model = loaded(&obj, &files).expect("a triangle");
        assert_eq!(model.positions[0], DVec3::ZERO);
        assert!(model.materials[0].base_texture.is_some() && model.notes.is_empty());
    }
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("wide.obj");
    let wide: Vec<u8> = "\u{feff}v 0 0 0\n".encode_utf16().flat_map(u16::to_le_bytes).collect();
    std::fs::write(&path, wide).expect("write");
    let error = load(&path).expect_err("UTF-16").to_string();
    assert!(error.contains("line 1") && error.contains("UTF-16"), "{error}");
}

#[test]
fn indices_outside_the_file_are_refused_with_their_line() {
    let head = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n";
    for (face, problem) in [
        ("0 1 2", "vertex index 0 is out of range"),
        ("1 2 4", "vertex index 4 is out of range"),
        ("-4 1 2", "vertex index -4 is out of range"),
        ("1/0 2/1 3/1", "texture index 0 is out of range"),
        ("1/1 2/-2 3/1", "texture index -2 is out of range"),
        ("1//9223372036854775807 2//1 3//1", "normal index 9223372036854775807 is out of range"),
        ("1//-9223372036854775808 2//1 3//1", "normal index -9223372036854775808 is out of range"),
        ("1 2 x", "\"x\" is not a vertex index"),
        ("/1 2 3", "a corner has no vertex index"),
    ] {
        let error = loaded(&format!("{head}f {face}\n"), &[]).expect_err("no such index");
        let error = error.to_string();
        assert!(error.contains("line 6") && error.contains(problem), "{error}");
    }
    assert!(loaded(&format!("{head}f -3/-1/-1 -2/1/1 3/1/1/7 # fine\n"), &[]).is_ok());
}

/// Metashape writes quotes around names with spaces.
#[test]
fn quotes_around_names_are_removed() {
    let mut png = Cursor::new(Vec::new());
    let red = image::RgbImage::from_pixel(1, 1, [255, 0, 0].into());
    red.write_to(&mut png, image::ImageFormat::Png).expect("png");
    let png = png.into_inner();
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n";
    for (library, texture) in
        [("\"my scene.mtl\"", "my tex.png"), ("\"my scene.mtl\"", "\"my tex.png\"")]
    {
        let material = format!("newmtl m\nmap_Kd -s 1 1 1 {texture}\n");
        let files = [("my scene.mtl", material.as_bytes()), ("my tex.png", &png[..])];
        let model = loaded(&format!("mtllib {library}\n{obj}"), &files).expect("a triangle");
        assert_eq!((model.notes.len(), model.textures.len()), (0, 1), "{:?}", model.notes);
    }
    let model = loaded(&format!("mtllib \"none.mtl\"\n{obj}"), &[]).expect("a triangle");
    assert!(model.notes[0].contains("none.mtl"), "{:?}", model.notes);
}

/// A file whose own name has quotes takes precedence. Windows has no such names.
#[cfg(unix)]
#[test]
fn names_may_have_quotes() {
    let files = [("\"a.mtl\"", &b"newmtl quoted\n"[..]), ("a.mtl", &b"newmtl plain\n"[..])];
    let obj = "mtllib \"a.mtl\"\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl quoted\nf 1 2 3\n";
    let model = loaded(obj, &files).expect("a triangle");
    assert_eq!(model.notes, Vec::<String>::new());
}
