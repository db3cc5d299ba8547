//! Tests of the whole command with scripts in place of the engine, which work, crash, are killed, or write nonsense.

use std::cell::RefCell;
use std::fmt;
use std::os::unix::fs::PermissionsExt;

use densify_core::files::disk::{Fault, Operation, with_fault};
use densify_run::Interrupt;
use densify_run::failure::Failure;
use glam::{DQuat, DVec3};

use super::*;
use crate::model::{Camera, FILES, Image, Model, Point};

/// Photographs of the tests.
const COUNT: usize = 12;

/// Collects lines, and may ask to stop.
#[derive(Default)]
struct Lines {
    said: RefCell<Vec<String>>,
    stop: bool,
}

impl Observer for Lines {
    fn say(&self, line: fmt::Arguments<'_>) {
        self.said.borrow_mut().push(line.to_string());
    }

    fn interrupt(&self) -> Option<Interrupt> {
        self.stop.then_some(Interrupt { name: "SIGINT", exit_code: 130 })
    }
}

impl Lines {
    fn has(&self, words: &str) -> bool {
        self.said.borrow().iter().any(|line| line.contains(words))
    }
}

/// A folder with photographs, and a place for prepared models, for the output, and for the engine.
struct Place {
    root: tempfile::TempDir,
    options: Options,
}

impl Place {
    fn new(photographs: usize) -> Self {
        let root = tempfile::tempdir().expect("a folder");
        let at = |name: &str| root.path().join(name);
        std::fs::create_dir(at("photos")).expect("a folder");
        for number in 0..photographs {
            let name = format!("photos/shot {number:02}.png");
            image::GrayImage::new(16, 12).save(at(&name)).expect("a picture");
        }
        let options = Options {
            input: at("photos"),
            output: at("scene"),
            python: Some(at("engine")),
            threads: 1,
            camera_model: "SIMPLE_RADIAL".to_owned(),
            frames: 10,
            keep_frame: true,
            overwrite: false,
        };
        Self { root, options }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.root.path().join(name)
    }

    /// Prepares a model of some of the photographs, with the matches that the true poses would have.
    fn prepare(
        &self,
        number: usize,
        photographs: std::ops::Range<usize>,
        change: impl Fn(&mut Model),
    ) {
        let folder = self.path("models").join(number.to_string());
        std::fs::create_dir_all(&folder).expect("a folder");
        let mut model = ring(photographs.clone());
        let pairs: Vec<serde_json::Value> = photographs
            .clone()
            .flat_map(|first| (first + 1..photographs.end.min(first + 4)).map(move |second| (first, second)))
            .map(|(first, second)| {
                let of = |at: usize| &model.images[at - photographs.start];
                let rotation = of(second).rotation * of(first).rotation.inverse();
                let [x, y, z, w] = rotation.to_array();
                let to = of(second).translation - rotation * of(first).translation;
                serde_json::json!({"first": of(first).name, "second": of(second).name, "inliers": 80,
                    "rotation": [w, x, y, z], "translation": to.to_array(), "parallax": 9.0})
            })
            .collect();
        change(&mut model);
        for name in FILES {
            let mut bytes = Vec::new();
            model.write(name, &mut bytes).expect("bytes");
            std::fs::write(folder.join(name), bytes).expect("a file");
        }
        std::fs::write(folder.join("pairs.json"), serde_json::to_vec(&pairs).expect("text"))
            .expect("a file");
    }

    /// Writes the engine: a script that notes each stage and does its part, but for stages with a line of their own.
    fn engine(&self, version: &str, own: &[(&str, &str)]) {
        let own: String = own
            .iter()
            .map(|(stage, line)| format!("[ $stage != {stage} ] || {{ {line}; }}\n"))
            .collect();
        let script = format!(
            r#"#!/bin/sh
[ "$1" != -c ] || {{ echo {version}; exit; }}
stage=$3
echo $stage >>'{root}/stages'
field() {{ sed 's/.*"'$1'":"\([^"]*\)".*/\1/' "$request"; }}
request=$4
echo "progress $stage 1 2"
{own}case $stage in
features) echo '{{"keypoints": [500, 500, 500]}}' >"$(field result)" ;;
pairs) echo '{{}}' >"$(field result)" ;;
mapping)
    mkdir -p "$(field models)"
    cp -r '{root}/models/'* "$(field models)"
    (cd '{root}/models' && ls) | paste -sd, - | sed 's/.*/{{"models": [&]}}/' >"$(field result)" ;;
esac
"#,
            root = self.root.path().display()
        );
        let path = self.path("engine");
        std::fs::write(&path, script).expect("a script");
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755))
            .expect("permissions");
    }

    fn find(&self) -> (Result<Found, PosesError>, Lines) {
        let lines = Lines::default();
        (find(&self.options, &lines), lines)
    }

    /// The message of a call that must fail with this code and leave no scene.
    fn refused(&self, code: u8, words: &[&str]) -> String {
        let failure = Failure::from(self.find().0.expect_err("a failure"));
        let message = failure.to_string();
        assert_eq!(failure.code, code, "{message}");
        for word in words {
            assert!(message.contains(word), "{word:?} is not in: {message}");
        }
        assert!(!self.options.output.exists(), "{message}: something was written");
        message
    }

    /// The stages that engines were asked for.
    fn stages(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.path("stages")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }
}

/// A fault in a model.
type Change = fn(&mut Model);

/// A model of photographs on a ring, all of which see the same points.
fn ring(photographs: std::ops::Range<usize>) -> Model {
    let image = |number: usize| {
        let rotation = DQuat::from_rotation_y(0.2 * number as f64);
        let observations = (0..40_u64).map(|point| ([1.0, 2.0], point)).collect();
        let (id, name) = (number as u32 + 1, format!("{number:06}.png"));
        Image {
            id,
            name,
            rotation,
            translation: DVec3::new(0.1, 0.0, 3.0),
            camera: 1,
            observations,
        }
    };
    let images: Vec<Image> = photographs.map(image).collect();
    let track: Vec<(u32, u32)> = images.iter().map(|image| (image.id, 0)).collect();
    let point = |id| Point {
        id,
        position: DVec3::ONE * id as f64,
        colour: [1, 2, 3],
        error: 0.5,
        track: track.clone(),
    };
    let camera = Camera { id: 1, model: 2, size: [16, 12], parameters: vec![20.0, 8.0, 6.0, 0.0] };
    Model { cameras: vec![camera], images, points: (0..40).map(point).collect() }
}

#[test]
fn a_scene_is_written_and_names_the_photographs_that_are_left_out() {
    let place = Place::new(COUNT + 1);
    place.engine("4.2.1", &[]);
    place.prepare(0, 0..COUNT, |model| model.images[5].rotation = DQuat::from_rotation_y(2.5));
    let (found, lines) = place.find();
    assert_eq!(found.expect("a scene"), Found { photographs: COUNT + 1, accepted: COUNT - 1 });
    assert!(
        lines.has("rejected 1 of 13: shot 05.png (") && lines.has("unplaced 1 of 13: shot 12.png"),
        "{:?}",
        lines.said
    );
    let model = Model::read(&place.path("scene/sparse/0")).expect("a model");
    let names: Vec<&str> = model.images.iter().map(|image| &*image.name).collect();
    assert_eq!(
        (names.len(), names[0], names.contains(&"shot 05.png")),
        (COUNT - 1, "shot 00.png", false)
    );
    assert!(model.points.iter().all(|point| point.track.len() == COUNT - 1));
    assert_eq!(std::fs::read_dir(place.path("scene/images")).expect("a folder").count(), COUNT - 1);
    assert!(!place.path("scene.unfinished").exists());
    // The same photographs are recognised, until one is added.
    assert!(is_current(&place.options.input, &place.options.output));
    image::GrayImage::new(16, 12).save(place.path("photos/more.png")).expect("a picture");
    assert!(!is_current(&place.options.input, &place.options.output));
    assert!(matches!(place.find().0, Err(PosesError::Occupied { .. })));
}

#[test]
fn a_scene_is_turned_upright_unless_it_is_to_stay() {
    let turn = DQuat::from_rotation_x(1.0);
    for keep_frame in [false, true] {
        let mut place = Place::new(COUNT);
        place.options.keep_frame = keep_frame;
        place.engine("4.2.1", &[]);
        place.prepare(0, 0..COUNT, |model| model.turn(turn));
        let (found, lines) = place.find();
        assert!(found.is_ok() && lines.has("upright") != keep_frame, "{found:?}");
        let model = Model::read(&place.path("scene/sparse/0")).expect("a model");
        let down = model.images[3].rotation.inverse() * DVec3::Y;
        let expected = if keep_frame { turn * DVec3::Y } else { DVec3::Y };
        assert!(down.distance(expected) < 1e-6, "{down}");
    }
}

#[test]
fn a_crash_is_one_message_and_the_next_call_continues() {
    let place = Place::new(COUNT);
    place.prepare(0, 0..COUNT, |_| ());
    for (line, words) in [
        ("echo 'it broke' >&2; exit 3", "failed with code 3: it broke"),
        ("kill -9 $$", "was ended by signal 9"),
        ("echo 'sqlite3: database or disk is full' >&2; exit 1", "make room"),
    ] {
        place.engine("4.2.1", &[("pairs", line)]);
        place.refused(2, &[words, "pycolmap (pairs)", "log.txt", "the same command"]);
    }
    place.engine("4.2.1", &[]);
    assert!(place.find().0.is_ok());
    // Keypoints were searched only once.
    assert_eq!(place.stages(), ["features", "pairs", "pairs", "pairs", "pairs", "mapping"]);
}

#[test]
fn nonsense_is_refused_and_says_what_to_remove() {
    let cases: [(&str, Change); 4] = [
        ("none of the photographs", |model| model.images[2].name = "../../other.png".to_owned()),
        ("which does not exist", |model| model.images[2].camera = 9),
        ("no rotation", |model| model.images[2].translation.x = f64::NAN),
        ("the parameters", |model| model.cameras[0].parameters[0] = f64::INFINITY),
    ];
    for (words, change) in cases {
        let place = Place::new(COUNT);
        place.engine("4.2.1", &[]);
        place.prepare(0, 0..COUNT, change);
        place.refused(2, &[words, "remove", "scene.unfinished"]);
    }
    for (stage, line) in [
        ("features", "echo '{' >\"$(field result)\"; exit"),
        ("mapping", "echo '{\"models\": [7]}' >\"$(field result)\"; exit"),
    ] {
        let place = Place::new(COUNT);
        place.engine("4.2.1", &[(stage, line)]);
        place.refused(2, &["remove", "scene.unfinished"]);
    }
    // Every truncation of a file is noticed.
    let place = Place::new(COUNT);
    place.prepare(0, 0..COUNT, |_| ());
    for name in FILES {
        let file = place.path("models/0").join(name);
        let bytes = std::fs::read(&file).expect("a file");
        for length in (0..bytes.len()).step_by(97) {
            std::fs::write(&file, &bytes[..length]).expect("a file");
            assert!(Model::read(&place.path("models/0")).is_err(), "{name} of {length} bytes");
        }
        std::fs::write(&file, &bytes).expect("a file");
    }
}

#[test]
fn a_missing_or_old_engine_is_named_and_nothing_is_left() {
    let place = Place::new(COUNT);
    place.refused(2, &["pip install pycolmap", "--python"]);
    assert!(!place.path("scene.unfinished").exists());
    place.engine("3.12.6", &[]);
    place.refused(2, &["pycolmap 3.12.6 is too old", "--upgrade"]);
}

#[test]
fn photographs_without_anything_in_common_are_refused() {
    let place = Place::new(COUNT);
    place.engine("4.2.1", &[("mapping", "echo '{\"models\": []}' >\"$(field result)\"; exit")]);
    place.refused(2, &["too few of the 12 photographs show the same things"]);
    // All settings were tried.
    assert_eq!(place.stages().iter().filter(|stage| *stage == "mapping").count(), 5);
}

#[test]
fn of_two_scenes_in_a_folder_the_larger_is_taken_and_the_other_named() {
    let place = Place::new(COUNT);
    place.engine("4.2.1", &[]);
    place.prepare(0, 0..5, |_| ());
    place.prepare(1, 5..COUNT, |_| ());
    let (found, lines) = place.find();
    assert_eq!(found.expect("a scene").accepted, 7);
    assert!(lines.has("5 photographs form a scene of their own"), "{:?}", lines.said);
}

#[test]
fn a_model_that_matches_contradict_is_refused() {
    let place = Place::new(COUNT);
    place.engine("4.2.1", &[]);
    place.prepare(0, 0..COUNT, |model| {
        for image in &mut model.images[3..8] {
            image.rotation = DQuat::from_rotation_x(0.9 * f64::from(image.id)) * image.rotation;
        }
    });
    place.refused(2, &["no poses are accepted", "contradict"]);
}

#[test]
fn five_photographs_are_enough_and_two_are_not() {
    let place = Place::new(5);
    place.engine("4.2.1", &[]);
    place.prepare(0, 0..5, |_| ());
    assert_eq!(place.find().0.expect("a scene").accepted, 5);
    let place = Place::new(2);
    std::fs::write(place.path("photos/a.HEIC"), "").expect("a file");
    std::fs::write(place.path("photos/a.mov"), "").expect("a file");
    let message = place.refused(
        2,
        &[
            "has 2 photographs, but at least 3 are needed",
            "a.HEIC",
            "Most Compatible",
            "Live Photo",
        ],
    );
    assert_eq!(message.lines().count(), 1);
}

#[test]
fn a_signal_ends_the_engine_and_a_full_disk_leaves_nothing_half_written() {
    let place = Place::new(COUNT);
    place.prepare(0, 0..COUNT, |_| ());
    place.engine("4.2.1", &[("features", "sleep 60")]);
    let lines = Lines { stop: true, ..Lines::default() };
    let stopped = find(&place.options, &lines);
    assert!(matches!(stopped, Err(PosesError::Stopped(_))), "{stopped:?}");
    place.engine("4.2.1", &[]);
    let kind = std::io::ErrorKind::StorageFull;
    for (operation, file) in [(Operation::Write, "points3D.bin"), (Operation::Rename, "poses.json")]
    {
        let fault = Fault { operation, file, spared: 0, kind };
        let (result, count) = with_fault(Some(fault), || place.refused(1, &["make room"]));
        assert!(count > 0, "{result}");
    }
    assert!(place.find().0.is_ok());
}
