//! Tests of reading: the same model in every format, as splat-transform 3.7.0 wrote it; damaged and dishonest files.
//!
//! The files are the fuzz corpora: `ply/twelve.ply` has twelve Gaussians of degree 1, and the others were made from it.

use std::path::Path;

use super::saved;
use crate::models::{is_model_folder, read_model};
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::{Gaussians, sigmoid};
use densify_fixtures::{corpus, corpus_files};

fn read(path: &Path) -> Gaussians {
    let file = read_model(path).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!((file.dropped, file.repaired), (0, 0), "{}", path.display());
    file.gaussians
}

/// A temporary folder with the files of the corpus entry `sog/folder`.
fn sog_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(corpus("sog/folder")).unwrap();
    for (name, contents) in corpus_files(&bytes, "meta.json") {
        std::fs::write(folder.path().join(name), contents).unwrap();
    }
    folder
}

/// Largest differences between two models with the same rows, in any order: of position, logarithm of scale, opacity,
/// colour in band 0, colour in band 1, and angle.
fn differences(a: &Gaussians, b: &Gaussians) -> [f32; 6] {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    let mut largest = [0f32; 6];
    let mut used = vec![false; b.len()];
    for row in 0..a.len() {
        let distance = |other: &usize| {
            let squared = |i: usize| (a.means[row][i] - b.means[*other][i]).powi(2);
            (0..3).map(squared).sum::<f32>().sqrt()
        };
        let nearest = (0..b.len()).min_by(|x, y| distance(x).total_cmp(&distance(y))).unwrap();
        assert!(!std::mem::replace(&mut used[nearest], true), "row {row} is there twice");
        let gap =
            |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
        let (p, q) = (a.quats[row], b.quats[nearest]);
        let norm = |q: [f32; 4]| q.iter().map(|v| v * v).sum::<f32>().sqrt();
        let cosine = p.iter().zip(q).map(|(p, q)| p * q).sum::<f32>() / norm(p) / norm(q);
        let found = [
            distance(&nearest),
            gap(&a.log_scales[row], &b.log_scales[nearest]),
            (sigmoid(a.opacity_logits[row]) - sigmoid(b.opacity_logits[nearest])).abs(),
            gap(&a.sh_of(row)[..3], &b.sh_of(nearest)[..3]),
            gap(&a.sh_of(row)[3..], &b.sh_of(nearest)[3..]),
            2.0 * (1.0 - cosine.abs()).max(0.0).sqrt() * std::f32::consts::SQRT_2,
        ];
        largest = std::array::from_fn(|i| largest[i].max(found[i]));
    }
    largest
}

/// The limits are half a quantisation step of each format, or one and a half steps where splat-transform does not round
/// to the nearest.
#[test]
fn every_format_holds_the_same_model() {
    let truth = read(&corpus("ply/twelve.ply"));
    assert_eq!((truth.len(), truth.sh_degree), (12, 1));
    let folder = sog_folder();
    for (path, limits) in [
        // Positions in 11 bits (y: 10) of a range of 4; colours in eight bits of a range of 3; bands from −4 to 4.
        (corpus("compressed-ply/twelve.ply"), [0.003, 0.002, 0.002, 0.006, 0.016, 0.003]),
        // Positions with 12 fractional bits; log-scales in sixteenths; colours in steps of 1/(255·0.15); bands rounded
        // to eight bits, then to five, of a range of 2; quaternions in nine bits.
        (corpus("spz/v3.spz"), [0.000_25, 0.032, 0.002, 0.014, 0.036, 0.004]),
        (corpus("spz/v4.spz"), [0.000_25, 0.032, 0.002, 0.014, 0.036, 0.004]),
        // Positions in 16 bits of logarithms; scales and colours in codebooks; bands in a palette, where two rows may
        // share an entry; quaternions in bytes of a range of √2, rounded down.
        (corpus("sog/stored.sog"), [0.000_3, 0.04, 0.004, 0.03, 0.4, 0.03]),
        (corpus("sog/deflated.sog"), [0.000_3, 0.04, 0.004, 0.03, 0.4, 0.03]),
        (folder.path().to_owned(), [0.000_3, 0.04, 0.004, 0.03, 0.4, 0.03]),
        (folder.path().join("meta.json"), [0.000_3, 0.04, 0.004, 0.03, 0.4, 0.03]),
        // Values in f32.
        (corpus("glb/twelve.glb"), [1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-3]),
    ] {
        let found = differences(&truth, &read(&path));
        assert!(found.iter().zip(limits).all(|(f, l)| *f <= l), "{}: {found:?}", path.display());
    }
    let splat = differences(&truth.clone().with_degree(0), &read(&corpus("splat/twelve.splat")));
    let limits = [0.0, 1e-6, 0.002, 0.007, 0.0, 0.02];
    assert!(splat.iter().zip(limits).all(|(f, l)| *f <= l), "{splat:?}");
}

/// A ZIP archive of these files.
fn archive(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, contents) in files {
        archive.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        std::io::Write::write_all(&mut archive, contents).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

/// As in other PLY files: properties that change the look are refused, all others are named.
#[test]
fn properties_of_compressed_ply_that_are_not_read_are_refused_or_noted() {
    let whole = std::fs::read(corpus("compressed-ply/twelve.ply")).unwrap();
    let end = whole.windows(11).position(|part| part == b"end_header\n").unwrap();
    let (header, data) = (str::from_utf8(&whole[..end]).unwrap(), &whole[end + 11..]);
    // The elements, each with the line after its properties, the number of its rows and their bytes.
    let elements = [("chunk", "element vertex", 1, 72), ("vertex", "element sh", 12, 16)];
    let elements = elements.into_iter().chain([("sh", "end_header", 12, 9)]);
    let with = |changed: &str, names: &[&str]| {
        let more: String = names.iter().map(|name| format!("property uchar {name}\n")).collect();
        let (mut header, mut rows, mut left) = (format!("{header}end_header\n"), Vec::new(), data);
        for (element, next, count, bytes) in elements.clone() {
            let own;
            (own, left) = left.split_at(count * bytes);
            let padding = if element == changed { vec![0; names.len()] } else { Vec::new() };
            rows.extend(own.chunks(bytes).flat_map(|row| [row, &padding].concat()));
            if element == changed {
                header = header.replace(next, &format!("{more}{next}"));
            }
        }
        let (_folder, path) = saved("file.ply", [header.as_bytes(), &rows].concat());
        read_model(&path).map_err(|error| error.to_string())
    };
    let plain = with("sh", &[]).unwrap();
    assert!(plain.notes.is_empty(), "{:?}", plain.notes);
    for element in ["chunk", "vertex", "sh"] {
        let noted = with(element, &["label", "red", "filter_3D"]).unwrap();
        assert_eq!(noted.notes, ["properties that are not read: label, filter_3D"], "{element}");
        assert_eq!(noted.gaussians, plain.gaussians, "{element}");
        let message = with(element, &["motion_0"]).unwrap_err();
        let words = ["file.ply: property motion_0", "move", "single moment"];
        assert!(words.iter().all(|word| message.contains(word)), "{element}: {message}");
    }
}

#[test]
fn an_archive_may_hold_the_folder_of_a_model() {
    let folder = sog_folder();
    let mut files = vec![("__MACOSX/scene/._meta.json".to_owned(), Vec::new())];
    for entry in std::fs::read_dir(folder.path()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap();
        files.push((format!("scene/{name}"), std::fs::read(&path).unwrap()));
    }
    let files: Vec<_> = files.iter().map(|(name, bytes)| (&**name, &**bytes)).collect();
    let (_folder, path) = saved("model.sog", archive(&files));
    assert_eq!(read(&path), read(folder.path()));
}

#[test]
fn file_names_do_not_matter() {
    for (name, format) in [("model.ply", "spz/v4.spz"), ("model.spz", "sog/stored.sog")] {
        let (_folder, path) = saved(name, std::fs::read(corpus(format)).unwrap());
        assert_eq!(read(&path).len(), 12, "{format} as {name}");
    }
}

#[test]
fn a_byte_order_mark_is_skipped() {
    for format in ["ply/twelve.ply", "compressed-ply/twelve.ply"] {
        let plain = std::fs::read(corpus(format)).unwrap();
        let (_folder, path) = saved("model.ply", ["\u{feff}".as_bytes(), &plain].concat());
        assert_eq!(read(&path), read(&corpus(format)), "{format}");
    }
}

#[test]
fn nodes_place_their_splats() {
    let placed = read(&corpus("gltf/placed.gltf"));
    let plain = read(&corpus("glb/twelve.glb"));
    // A mean is converted to glTF's frame, where (x, y, z) is turned to (z, x, y), doubled and shifted; the result is
    // converted back.
    let expected = |[x, y, z]: [f32; 3]| {
        let [x, y, z] = [-x, -y, z];
        let [x, y, z] = [2.0 * z + 1.0, 2.0 * x + 2.0, 2.0 * y + 3.0];
        [-x, -y, z]
    };
    // Some editors put a byte-order mark before the text.
    let folder = tempfile::tempdir().unwrap();
    let marked = folder.path().join("marked.gltf");
    let text = std::fs::read(corpus("gltf/placed.gltf")).unwrap();
    std::fs::write(&marked, ["\u{feff}".as_bytes(), &text].concat()).unwrap();
    assert_eq!(read(&marked), placed);
    for row in 0..12 {
        let far = |i: usize| (placed.means[row][i] - expected(plain.means[row])[i]).abs();
        assert!((0..3).all(|i| far(i) < 1e-5), "row {row}: {:?}", placed.means[row]);
        let larger = placed.log_scales[row][0] - plain.log_scales[row][0];
        assert!((larger - 2f32.ln()).abs() < 1e-5, "{larger}");
    }
    // A primitive with data in SPZ, below a node that rotates it by 90 degrees about x.
    let one = read(&corpus("glb/spz.glb"));
    assert_eq!(one.means, [[-1.0, -3.0, -2.0]]);
}

/// A file cut or damaged anywhere gives an error or a model, never a panic or a huge allocation.
#[test]
fn no_damage_makes_a_reader_panic() {
    for (format, may_be_cut) in [
        ("compressed-ply/twelve.ply", false),
        ("spz/v2.spz", false),
        ("spz/v3.spz", false),
        ("spz/v4.spz", false),
        ("sog/deflated.sog", false),
        ("splat/twelve.splat", true),
        ("glb/twelve.glb", false),
        ("glb/spz.glb", false),
    ] {
        let whole = std::fs::read(corpus(format)).unwrap();
        let (_folder, path) = saved("model", "");
        for at in (0..whole.len()).step_by(1 + whole.len() / 500) {
            std::fs::write(&path, &whole[..at]).unwrap();
            let cut = read_model(&path);
            let whole_rows = may_be_cut && at % 32 == 0 && at > 0;
            assert_eq!(cut.is_ok(), whole_rows, "{format} cut at {at}");
            let mut damaged = whole.clone();
            damaged[at] ^= 0x95;
            std::fs::write(&path, damaged).unwrap();
            if let Err(error) = read_model(&path) {
                assert!(error.to_string().contains("model"), "{format}: {error}");
            }
        }
    }
}

#[test]
fn dishonest_files_are_refused_with_the_reason() {
    let changed = |format: &str, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = std::fs::read(corpus(format)).unwrap();
        change(&mut bytes);
        bytes
    };
    // The header of SPZ version 4 is not compressed, so it can be changed in place.
    let spz = |at: usize, to: u8| changed("spz/v4.spz", &|bytes| bytes[at] = to);
    let text = |format: &str, from: &str, to: &str| {
        let bytes = std::fs::read(corpus(format)).unwrap();
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).expect(from);
        [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
    };
    let gltf = "gltf/placed.gltf";
    // A file of less than 1 MiB that claims 2^30 Gaussians and holds 80 MiB of zeros.
    let mut bomb = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    let header = [0x5053_474e_u32.to_le_bytes(), 3u32.to_le_bytes(), (1u32 << 30).to_le_bytes()];
    std::io::Write::write_all(&mut bomb, &[&header.concat()[..], &[0, 12, 0, 0]].concat()).unwrap();
    std::io::Write::write_all(&mut bomb, &vec![0; 80 << 20]).unwrap();
    for (case, contents, words) in [
        (
            "nothing",
            Vec::new(),
            &["compressed-ply, glb, gltf, ply, sog, splat, spz", "convert"][..],
        ),
        ("zeros", vec![0; 320], &["convert"]),
        ("other JSON", b"{\"frames\":[]}".to_vec(), &["not a model", "convert"]),
        ("a ZIP", archive(&[("a.ply", b"ply")]), &["ZIP archive, but no SOG", "unpack it"]),
        (
            "a model among others",
            archive(&[("a/meta.json", b"{}"), ("b/meta.json", b"{}")]),
            &["ZIP archive, but no SOG"],
        ),
        // The head of a .ksplat: its version, then the number of its sections.
        (
            "a ksplat",
            [&[0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0][..], &[0; 4084]].concat(),
            &["convert"],
        ),
        ("a picture", b"\x89PNG\r\n\x1a\n0123".to_vec(), &["convert"]),
        ("a pointer", b"version https://git-lfs.github.com/spec/v1\n".to_vec(), &["git lfs pull"]),
        ("version 5", spz(4, 5), &["header", "2 and 3, in gzip, and 4, not 5"]),
        ("a damaged frame", spz(96, 0xff), &["compressed data is damaged"]),
        ("degree 4", spz(12, 4), &["degree 4"]),
        ("too many rows", spz(11, 255), &["header", "too many for a file of 497"]),
        ("table in the header", spz(16, 8), &["table"]),
        ("other sizes", spz(40, 1), &["positions", "12 Gaussians of 9"]),
        ("a bomb", bomb.finish().unwrap(), &["header", "too many for a file"]),
        (
            "rows without chunks",
            text("compressed-ply/twelve.ply", "chunk 1\n", "chunk 2\n"),
            &["12 vertices", "2 chunks"],
        ),
        (
            "no packed_scale",
            text("compressed-ply/twelve.ply", "packed_scale", "packed_s"),
            &["packed_scale"],
        ),
        ("a mesh", text(gltf, "\"KHR_gaussian_splatting\":{", "\"x\":{"), &["no Gaussian splats"]),
        (
            "an unknown required extension",
            text(gltf, "\"extensionsUsed\"", "\"extensionsRequired\":[\"KHR_x\"],\"e\""),
            &["requires KHR_x"],
        ),
        ("linear colours", text(gltf, "srgb_rec709", "lin_rec709"), &["lin_rec709_display"]),
        (
            "triangles",
            text(gltf, "\"mode\":0", "\"mode\":4"),
            &["primitives: mode: 4 is triangles", "splats (KHR_gaussian_splatting) are points"],
        ),
        ("an unknown mode", text(gltf, "\"mode\":0", "\"mode\":7"), &["mode: 7 is unknown"]),
        ("indices", text(gltf, "\"mode\":0", "\"indices\":0"), &["indices", "order"]),
        ("an uneven scale", text(gltf, "[2,2,2]", "[2,2,3]"), &["nodes", "even scale"]),
        (
            "a node in itself",
            text(gltf, "\"rotation\":", "\"children\":[0],\"rotation\":"),
            &["contain each other"],
        ),
        (
            "beyond its view",
            text(gltf, "\"count\":12", "\"count\":1200"),
            &["POSITION", "beyond its view"],
        ),
        ("different counts", text(gltf, "\"count\":12", "\"count\":11"), &["different counts"]),
        (
            "out of the folder",
            text(gltf, "data:application/octet-stream;base64,", "../"),
            &["buffers", "plain name"],
        ),
    ] {
        let (_folder, path) = saved("model.bin", contents);
        let message = read_model(&path).expect_err(case).to_string();
        for word in words.iter().chain(&["model.bin"]) {
            assert!(message.contains(word), "{case}: {word:?} is not in: {message}");
        }
    }
    let message = read_model(tempfile::tempdir().unwrap().path()).unwrap_err().to_string();
    assert!(message.contains("without meta.json"), "{message}");
}

#[test]
fn lists_of_models_are_refused_with_the_file_to_name() {
    // A tileset has an asset, as glTF does.
    let tileset = |root: &str| format!(r#"{{"asset":{{}},"geometricError":1,"root":{{{root}}}}}"#);
    let nested = tileset(r#""children":[{"content":{"uri":"a/b.glb"}}]"#);
    for (name, contents, words) in [
        ("lod-meta.json", "{\"lodLevels\":1}", ["levels of detail", "one of the meta.json files"]),
        (
            "tileset.json",
            &nested,
            ["a tileset (3D Tiles)", "a file that it lists, such as a/b.glb"],
        ),
        ("tileset.json", &tileset(""), ["a tileset (3D Tiles)", "name one of the files"]),
    ] {
        let (folder, path) = saved(name, contents);
        let message = read_model(&path).unwrap_err().to_string();
        assert!(message.contains(name) && words.iter().all(|w| message.contains(w)), "{message}");
        // The folder of a streamed model.
        let of_folder = read_model(folder.path()).unwrap_err().to_string();
        assert_eq!(is_model_folder(folder.path()), name == "lod-meta.json");
        assert_eq!(of_folder == message, name == "lod-meta.json", "{of_folder}");
    }
    for folder in ["", "city/"] {
        let [list, model] =
            ["lod-meta.json", "0_0/meta.json"].map(|name| format!("{folder}{name}"));
        let (_folder, path) = saved("city.zip", archive(&[(&list, b"{}"), (&model, b"{}")]));
        let message = read_model(&path).unwrap_err().to_string();
        for words in ["city.zip is a streamed SOG", "levels of detail", "unpack it, and name one"] {
            assert!(message.contains(words), "{folder:?}: {words:?} is not in: {message}");
        }
    }
}

#[test]
fn faults_of_a_sog_folder_are_named() {
    let folder = sog_folder();
    let meta = folder.path().join("meta.json");
    let good = std::fs::read_to_string(&meta).unwrap();
    for (case, from, to, words) in [
        ("version", "\"version\":2", "\"version\":3", &["version 3", "reads 2"][..]),
        ("no version", "\"version\":2,", "", &["version 1"]),
        ("count", "\"count\":12", "\"count\":999999", &["means", "999999 Gaussians"]),
        ("bands", "\"bands\":1", "\"bands\":2", &["shN", "too narrow"]),
        ("leads out", "means_l.webp", "../means_l.webp", &["plain name"]),
        ("missing", "means_l.webp", "means_m.webp", &["means_m.webp"]),
        ("no picture", "means_l.webp", "meta.json", &["neither WebP nor PNG"]),
        ("few files", "\"means_l.webp\",", "", &["means", "too few"]),
        ("bounds", "\"mins\"", "\"min\"", &["fewer than 3"]),
    ] {
        assert!(good.contains(from), "{case}");
        std::fs::write(&meta, good.replacen(from, to, 1)).unwrap();
        let message = read_model(folder.path()).expect_err(case).to_string();
        assert!(words.iter().all(|word| message.contains(word)), "{case}: {message}");
    }
    std::fs::write(&meta, good.replace("\"count\":12", "\"count\":3")).unwrap();
    assert_eq!(read(folder.path()).len(), 3);
}

#[cfg(unix)]
#[test]
fn no_link_leads_out_of_the_folder() {
    let (outside, folder) = (sog_folder(), sog_folder());
    let picture = folder.path().join("quats.webp");
    std::fs::remove_file(&picture).unwrap();
    std::os::unix::fs::symlink(outside.path().join("quats.webp"), &picture).unwrap();
    let message = read_model(folder.path()).unwrap_err().to_string();
    assert!(message.contains("leads out of the folder"), "{message}");
}

#[test]
#[ignore = "needs files of other programs: set DENSIFY_SHARED"]
fn shared_models_of_other_programs_load() {
    let folder = densify_fixtures::shared("splats");
    let at = |name: &str| read(&folder.join(name));
    let guitar = at("guitar.compressed.ply");
    assert_eq!((guitar.len(), guitar.sh_degree), (90_854, 0));
    assert_eq!(at("playcanvas_test.compressed_sh3.ply").sh_degree, 3);
    assert_eq!(at("gsplat-rs/minimal_v4_degree0.spz").len(), 8);
    // The same three Gaussians; in SPZ they have a half turn about x.
    let ply = at("metalsplatter/test-splat.3-points-from-train.ply");
    let splat = at("metalsplatter/test-splat.3-points-from-train.splat");
    let spz = at("metalsplatter/test-splat.3-points-from-train.spz");
    for row in 0..3 {
        let near = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 2e-4);
        assert!(near(ply.means[row], splat.means[row]), "{:?}", splat.means);
        let [x, y, z] = spz.means[row];
        assert!(near(ply.means[row], [x, -y, -z]), "{:?}", spz.means);
    }
    // Four Gaussians, with the figures that splat-transform 3.7.0 reports.
    for (name, y, first) in [
        ("minimal-v2.spz", -1.0, -1.111_111_2),
        ("minimal-v3.spz", 1.0, -0.588_235_3),
        ("minimal-v4.spz", 1.0, -0.588_235_3),
        ("minimal.splat", -1.0, -0.590_817_9),
    ] {
        let found = at(&format!("splat-transform/{name}"));
        assert_eq!((found.len(), found.means[0]), (4, [-1.0, 0.0, y]), "{name}");
        assert!((found.opacity_logits[0] - 2.219_203_5).abs() < 1e-5, "{name}");
        assert!((found.sh[0] - first).abs() < 1e-6, "{name}: {}", found.sh[0]);
    }
    let message = read_model(&folder.join("splat-transform/minimal.ksplat")).unwrap_err();
    assert!(message.to_string().contains("splat-transform"), "{message}");
}

/// SOG states antialiasing in `model`, formerly in `antialias`; neither states the size of the kernel.
#[test]
fn both_antialiasing_statements_of_sog_are_read() {
    let folder = sog_folder();
    let meta = folder.path().join("meta.json");
    let text = std::fs::read_to_string(&meta).unwrap();
    let mut parsed: serde_json::Value = serde_json::from_str(&text).unwrap();
    for (model, antialias, expected) in [
        (serde_json::json!("antialiased"), serde_json::Value::Null, Antialiasing::Wide),
        (serde_json::Value::Null, true.into(), Antialiasing::Wide),
        (serde_json::Value::Null, false.into(), Antialiasing::None),
        (serde_json::json!("other"), serde_json::Value::Null, Antialiasing::None),
    ] {
        (parsed["model"], parsed["antialias"]) = (model, antialias);
        parsed["asset"] = serde_json::json!({});
        std::fs::write(&meta, parsed.to_string()).unwrap();
        let found = read_model(folder.path()).unwrap();
        assert_eq!(found.gaussians.antialiasing, expected, "{parsed}");
        assert_eq!(found.notes.len(), usize::from(expected.is_on()), "{:?}", found.notes);
    }
}
