//! Tests of folders with photographs whose cameras are not known.

use std::fs;
use std::path::Path;

use ::exif::{Rational, Tag, Value};

use super::super::*;
use super::exif::{turned, write_exif};

fn picture(folder: &Path, name: &str) {
    let path = folder.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    ::image::RgbImage::new(6, 4).save(path).unwrap();
}

fn names(found: &Photographs) -> Vec<&str> {
    found.all.iter().map(|photograph| &*photograph.name).collect()
}

#[test]
fn photographs_are_listed_with_what_cannot_be_used() {
    let root = tempfile::tempdir().unwrap();
    for name in ["b.png", "a.JPG", "day 2/c.png", "masks/b.png", ".hidden/d.png", "sparse/e.png"] {
        picture(root.path(), name);
    }
    for name in ["a.mov", "film.mp4", "x.HEIC", "y.heif", "z.dng", "notes.txt"] {
        fs::write(root.path().join(name), "").unwrap();
    }
    let found = Photographs::list(root.path()).unwrap();
    assert_eq!(names(&found), ["a.JPG", "b.png", "day 2/c.png"]);
    assert_eq!((found.all[0].size, found.all[0].lens.clone()), ((6, 4), None));
    let masks = found.all.iter().map(|photograph| photograph.mask.is_some());
    assert_eq!(masks.collect::<Vec<_>>(), [false, true, false]);
    let notes = found.notes.join("\n");
    for words in [
        "x.HEIC and 1 more (HEIC is not read",
        "z.dng (raw files",
        "film.mp4 (videos among",
        "a.mov (each is the film of a Live Photo",
    ] {
        assert!(notes.contains(words), "{words:?} is not in: {notes}");
    }
    // A folder `images/` has all photographs, and its masks lie beside it.
    picture(root.path(), "images/b.png");
    let found = Photographs::list(root.path()).unwrap();
    assert_eq!((names(&found), found.all[0].mask.is_some()), (vec!["b.png"], true));
    // A file that is no picture is an error.
    fs::write(root.path().join("images/c.png"), "no picture").unwrap();
    assert!(Photographs::list(root.path()).unwrap_err().to_string().contains("c.png"));
}

#[test]
fn lens_and_orientation_come_from_exif() {
    let root = tempfile::tempdir().unwrap();
    let text = |tag, text: &str| (tag, Value::Ascii(vec![text.as_bytes().to_vec()]));
    let focal = |num| (Tag::FocalLength, Value::Rational(vec![Rational { num, denom: 10 }]));
    let lens = |num| vec![text(Tag::Make, "A"), text(Tag::Model, "B"), focal(num)];
    let fields = [lens(42), lens(42), lens(18), vec![focal(42)], turned(6), turned(8), turned(3)];
    for (number, fields) in fields.into_iter().enumerate() {
        let name = format!("{number}.png");
        picture(root.path(), &name);
        write_exif(&root.path().join(name), fields);
    }
    let all = Photographs::list(root.path()).unwrap().all;
    assert!(all[0].lens.is_some() && all[0].lens == all[1].lens && all[0].lens != all[2].lens);
    assert_eq!(all[3].lens, None);
    let up: Vec<[f64; 2]> = all[3..].iter().map(|photograph| photograph.up).collect();
    assert_eq!(up, [[0.0, -1.0], [-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]);
    // Sizes are those of the pixels as they are stored.
    assert_eq!(all[4].size, (6, 4));
}
