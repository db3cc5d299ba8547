//! Bad input: exit code 2, one message that names file, field or flag and says what to do, and
//! nothing left behind.

use super::{densify, files, scratch, text, train};
use crate::photographs::Photographs;

/// A case: what is wrong, how the dataset is damaged, further flags, and what must be said.
type Fault = (&'static str, fn(&Photographs), &'static str, &'static [&'static str]);

fn leave(_: &Photographs) {}

fn check(make: fn() -> Photographs, faults: &[Fault]) {
    for (case, damage, flags, words) in faults {
        let scene = make();
        damage(&scene);
        let (root, run) = scratch();
        let budget = if flags.contains("--budget") { "" } else { "--budget 400 " };
        let outcome = train(scene.path(), &run, 20, &format!("{budget}{flags}"));
        outcome.refused(case, words);
        assert!(!run.exists(), "{case}: it left {:?}", files(root.path()).keys());
    }
}

#[test]
fn flags_out_of_range_are_refused() {
    let faults: &[Fault] = &[
        ("unknown policy", leave, "--policy diett", &["diett", "`diet`"]),
        ("unknown parameter", leave, "--policy-set diet.rhoo=0.2", &["rhoo", "`rho`"]),
        ("bad value", leave, "--policy-set diet.rho=-1", &["rho"]),
        ("no number", leave, "--policy-set diet.rho=much", &["rho", "much"]),
        ("no form", leave, "--policy-set rho", &["--policy-set", "rho"]),
        ("other policy", leave, "--policy-set vanilla.tau=1", &["vanilla", "--policy"]),
        ("budget 0", leave, "--budget 0", &["--budget", "between 1"]),
        ("budget is a word", leave, "--budget many", &["--budget", "many", "200k"]),
        ("half a row", leave, "--budget 0.5", &["--budget", "0.5"]),
        ("budget too large", leave, "--budget 5000M", &["--budget", "4 billion"]),
        ("no training view", leave, "--test-every 1", &["no view is left", "--test-every"]),
        ("every 0", leave, "--test-every 0", &["--test-every"]),
        ("cache", leave, "--image-cache much", &["--image-cache", "1GiB"]),
        ("background", leave, "--background mauve", &["--background", "mauve", "#808080"]),
        ("learning rate", leave, "--lr opacity=x", &["--lr", "NAME=RATE"]),
        ("rate's name", leave, "--lr colour=1", &["--lr", "colour"]),
        ("steps of colour", leave, "--sh-every 0", &["--sh-every", "from 1 to 1000"]),
        ("save beyond the end", leave, "--save-iterations 21", &["--save-iterations", "1 to 20"]),
        ("nothing to test", leave, "--test-iterations 5", &["--test-iterations", "--eval"]),
        ("images elsewhere", leave, "--images photos", &["photos"]),
        ("points and random", leave, "--init points --init-points 5", &["--init-points"]),
        ("near", leave, "--near 1", &["--near", "less than 1"]),
        ("policy file", leave, "--policy-config /no/such/file", &["--policy-config", "/no/such"]),
    ];
    check(Photographs::colmap_text, faults);
}

#[test]
fn damaged_text_is_refused() {
    const IMAGES: &str = "sparse/0/images.txt";
    const CAMERAS: &str = "sparse/0/cameras.txt";
    let faults: &[Fault] = &[
        (
            "empty folder",
            |scene| {
                for folder in ["images", "sparse"] {
                    std::fs::remove_dir_all(scene.file(folder)).unwrap();
                }
            },
            "",
            &["is not a dataset", "COLMAP"],
        ),
        ("no image", |scene| scene.write(IMAGES, "# none\n"), "", &["images.txt", "no image"]),
        (
            "camera model",
            |scene| scene.replace(CAMERAS, "PINHOLE", "MAGIC"),
            "",
            &["cameras.txt", "MAGIC", "image_undistorter"],
        ),
        (
            "pose",
            |scene| {
                let text = std::fs::read_to_string(scene.file(IMAGES)).unwrap();
                let line = text.lines().next().unwrap();
                let mut fields: Vec<&str> = line.split(' ').collect();
                fields[5] = "nan";
                scene.replace(IMAGES, line, &fields.join(" "));
            },
            "",
            &["images.txt", "view_00.png", "not finite"],
        ),
        (
            "out of the folder",
            |scene| scene.replace(IMAGES, "view_03.png", "../view_03.png"),
            "",
            &["images.txt", "../view_03.png", "--images"],
        ),
        (
            "image missing",
            |scene| std::fs::remove_file(scene.file("images/view_03.png")).unwrap(),
            "",
            &["view_03.png", "--images"],
        ),
        (
            "image of another size",
            |scene| image::RgbImage::new(40, 48).save(scene.file("images/view_03.png")).unwrap(),
            "",
            &["view_03.png", "40x48", "48x40"],
        ),
        (
            "no image at all",
            |scene| scene.write("images/view_03.png", "hello"),
            "",
            &["view_03.png", "decode"],
        ),
    ];
    check(Photographs::colmap_text, faults);
}

#[test]
fn damaged_binaries_are_refused() {
    let faults: &[Fault] = &[
        (
            "points cut",
            |scene| scene.truncate("sparse/0/points3D.bin", 5),
            "",
            &["points3D.bin", "number of points", "export the model again"],
        ),
        (
            "images cut",
            |scene| scene.truncate("sparse/0/images.bin", 30),
            "",
            &["images.bin", "truncated"],
        ),
        (
            "cameras gone",
            |scene| scene.write("sparse/0/cameras.bin", ""),
            "",
            &["cameras.bin", "truncated"],
        ),
    ];
    check(Photographs::colmap_binary, faults);
    let faults: &[Fault] = &[
        (
            "no JSON",
            |scene| scene.truncate("transforms_train.json", 9),
            "",
            &["transforms_train.json"],
        ),
        (
            "no angle",
            |scene| scene.replace("transforms_train.json", "camera_angle_x", "camera"),
            "",
            &["transforms_train.json", "camera_angle_x"],
        ),
        ("points of none", leave, "--init points", &["--init random"]),
    ];
    check(Photographs::transforms, faults);
}

/// The header is sound, so that the fault shows only when the pixels are decoded, in training.
#[test]
fn a_photograph_cut_short_ends_the_run() {
    let scene = Photographs::colmap_text();
    scene.truncate("images/view_03.png", 600);
    let (_root, run) = scratch();
    let failed = |flags: &str| {
        let outcome = train(scene.path(), &run, 20, &format!("--budget 400 --quiet {flags}"));
        outcome.refused("cut short", &["images/view_03.png", "cannot decode"]);
        outcome
    };
    failed("");
    assert!(!run.exists());
    // What was learned before is kept, and it is said where.
    let outcome = failed("--save-iterations 1 --seed 4");
    assert!(outcome.stderr.contains("was written until then"), "{}", outcome.stderr);
    assert!(!super::model(&run, 1).is_empty());
    assert_eq!(super::json(&run.join("stats/summary.json"))["finished"], false);
}

#[test]
fn scenes_and_outputs_that_are_not_there_are_refused() {
    let (root, run) = scratch();
    let scene = root.path().join("no-such-folder");
    train(&scene, &run, 20, "").refused("no scene", &["no-such-folder", "check that it exists"]);
    assert!(!run.exists());

    let photographs = Photographs::colmap_text();
    std::fs::write(&run, "a file").unwrap();
    train(photographs.path(), &run, 20, "").refused("a file", &["not a folder", "-o"]);
    assert_eq!(std::fs::read(&run).unwrap(), b"a file");

    densify(&["eval", text(root.path())]).refused("eval", &["holds no run", "densify train"]);
    let pictures = root.path().join("pictures");
    let render = |model: &str| densify(&["render", model, "-o", text(&pictures)]);
    render(text(root.path())).refused("render", &["holds no run"]);
    let ply = root.path().join("model.ply");
    std::fs::write(&ply, "ply\nformat ascii 1.0\nend_header\n").unwrap();
    let (ply, dataset) = (text(&ply), text(photographs.path()));
    densify(&["render", ply, "--scene", dataset, "--split", "train", "-o", text(&pictures)])
        .refused("no splats", &["model.ply"]);
    assert!(!pictures.exists());
    assert_eq!(files(root.path()).len(), 2, "something was left behind");
}
