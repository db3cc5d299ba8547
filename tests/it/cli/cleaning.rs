//! `densify clean`: what it removes and reports, and refused calls.

use std::cell::Cell;
use std::path::Path;

use densify::clean::{Options, Rules, clean};
use densify::core::gaussians::{Gaussians, logit, rgb_to_dc};
use densify::data::models::PLY;
use densify::render::BackendChoice;
use densify::run::refining::TrainedModel;
use densify::run::{DataSpec, DepthSpec, DeviceSpec, Interrupt, Observer};

use super::{call, gaussians, read, read_text, scratch, text, train};
use crate::photographs::{Photographs, VIEWS, camera};

/// The model, and more small grey Gaussians at one place.
fn with_more(
    model: &Gaussians,
    count: usize,
    place: [f32; 3],
    (scale, opacity): (f32, f32),
) -> Gaussians {
    let mut more = Gaussians::zeros(count, 0).with_degree(model.sh_degree);
    more.antialiasing = model.antialiasing;
    more.means.fill(place);
    more.quats.fill([1.0, 0.0, 0.0, 0.0]);
    more.log_scales.fill([scale.ln(); 3]);
    more.opacity_logits.fill(logit(opacity));
    more.sh.fill(rgb_to_dc(0.5));
    let mut all = model.clone();
    all.append(more);
    all
}

#[test]
fn floaters_go_and_the_model_stays() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, "--budget 300 --eval --quiet").ok();
    let model = run.join("point_cloud/iteration_60/point_cloud.ply");
    let original = read(&model);
    // Ten Gaussians that no view shows, because they are as good as transparent.
    let trained: Gaussians = gaussians(&model);
    let rows = trained.len();
    let changed = with_more(&trained, 10, [0.0; 3], (0.007, 1e-4));
    let with_unseen = root.path().join("unseen.ply");
    PLY.save(&changed, &with_unseen).expect("a model");
    let clean = |from: &Path, name: &str, flags: &str| {
        let output = root.path().join(name);
        (call(&format!("clean {} -o {} {flags}", text(from), text(&output))), output)
    };
    let scene_flag = format!("--scene {}", text(scene.path()));
    let only_unseen = format!("{scene_flag} --keep-in-front --isolated 0");
    let (outcome, cleaned) = clean(&with_unseen, "a.ply", &only_unseen);
    let stdout = outcome.ok().stdout;
    let kept = gaussians(&cleaned).len();
    assert!(kept <= rows && kept > rows / 2, "{kept} of {rows}: {stdout}");
    for word in ["round 1", "in no training view", "0.000 % of the weight", "test views", "cleaned"]
    {
        assert!(stdout.contains(word), "{word} is not in {stdout}");
    }
    // What no view shows does not change a picture.
    assert!(stdout.contains("(+0.000)"), "{stdout}");
    // The run is an input as well; rounds end when nothing is left to remove, and refining trains the rest.
    let (outcome, cleaned) = clean(&run, "b.ply", "--rounds 9 --refine 10 --backend cpu");
    let stdout = outcome.ok().stdout;
    assert!(stdout.contains("refined") && stdout.contains("for 10 iterations"), "{stdout}");
    let refined = gaussians(&cleaned).len();
    assert!(refined > 0 && refined < rows, "{refined} of {rows}: {stdout}");
    assert!(stdout.contains("in front of the surface"), "{stdout}");
    // Neither the number of threads nor a repetition changes the file.
    let (outcome, again) = clean(&run, "c.ply", "--rounds 9 --refine 10 --backend cpu --threads 1");
    outcome.ok();
    assert!(read(&again) == read(&cleaned));
    assert!(read(&model) == original);
    // Refining has the depth options of the run.
    let config = run.join("config.toml");
    let original_config = read_text(&config);
    std::fs::write(&config, format!("distortion_weight = 100\n{original_config}")).expect("write");
    let (outcome, with_distortion) = clean(&run, "e.ply", "--rounds 9 --refine 10 --backend cpu");
    outcome.ok();
    assert!(read(&with_distortion) != read(&cleaned));
    std::fs::write(&config, original_config).expect("write");

    let path = text(&model);
    for (from, name, flags, words) in [
        (&model, "d.ply", "", &["no photographs", "--scene DIR"][..]),
        (&run, "d.xyz", "", &["-o:", "--format"]),
        (&run, "a.ply", "", &["a.ply exists", "--overwrite"]),
        (&run, "d.ply", "--margin 1.5", &["--margin"]),
        (&run, "d.ply", "--isolated 1.5", &["--isolated", "from 0 to 1"]),
        (&run, "d.ply", "--box 1,1,1,0,0,0", &["--box", "smallest"]),
        (&run, "d.ply", "--box 900,900,900,901,901,901", &["no Gaussian would be left", "box"]),
        (&run, "d.ply", "--eval", &["--eval"]),
    ] {
        clean(from, name, flags).0.refused(flags, words);
    }
    assert!(!root.path().join("d.ply").exists());
    // The model is never overwritten, by whatever path it is named.
    for from in [&run, &model] {
        let scene_flag = if from == &run { "" } else { &scene_flag };
        let words = format!("clean {} -o {path} --overwrite {scene_flag}", text(from));
        call(&words).refused("the model itself", &["is the model itself"]);
    }
    assert!(read(&model) == original);
}

#[test]
fn a_floater_near_a_camera_goes_and_the_surface_stays() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, "--budget 300 --eval --quiet").ok();
    let model = gaussians(&run.join("point_cloud/iteration_60/point_cloud.ply"));
    // On the optical axis of a training view, at a fifth of the distance of what it shows.
    let place = (0.8 * camera(1).centre()).as_vec3().to_array();
    let cleaned = |model: &Gaussians, flags: &str| {
        let (from, to) = (root.path().join("from.ply"), root.path().join("to.ply"));
        PLY.save(model, &from).expect("a model");
        let flags = format!("--isolated 0 --keep-unseen --overwrite {flags}");
        call(&format!(
            "clean {} -o {} --scene {} {flags}",
            text(&from),
            text(&to),
            text(scene.path())
        ))
        .ok();
        gaussians(&to)
    };
    let has_floater = |model: &Gaussians| model.means.contains(&place);
    let planted = with_more(&model, 1, place, (0.05, 0.45));
    assert!(has_floater(&cleaned(&planted, "--keep-in-front")));
    let (with, without) = (cleaned(&planted, ""), cleaned(&model, ""));
    assert!(!has_floater(&with));
    // All others are judged as if there were no floater.
    let stays = |mean: &&[f32; 3]| with.means.contains(*mean);
    let stayed = without.means.iter().filter(stays).count();
    assert!(without.len() > model.len() / 2, "{} of {}", without.len(), model.len());
    assert!(stayed * 20 >= without.len() * 19, "{stayed} of {}", without.len());
}

/// Asks to stop after some questions.
struct Stopping {
    questions: Cell<usize>,
    after: usize,
}

impl Observer for Stopping {
    fn interrupt(&self) -> Option<Interrupt> {
        self.questions.set(self.questions.get() + 1);
        (self.questions.get() > self.after).then_some(Interrupt { name: "SIGINT", exit_code: 130 })
    }
}

#[test]
fn a_signal_stops_between_any_two_views() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 20, "--budget 300 --eval --quiet").ok();
    let model = run.join("point_cloud/iteration_20/point_cloud.ply");
    let output = root.path().join("a.ply");
    let options = Options {
        model: TrainedModel {
            file: model,
            scene: scene.path().to_owned(),
            data: DataSpec { eval: true, ..DataSpec::default() },
            depth: DepthSpec::default(),
            exposure: None,
            poses: (densify::train::poses::PoseChoice::Fixed, false),
            vignette: false,
            near: None,
        },
        antialias: None,
        device: DeviceSpec { backend: BackendChoice::Cpu, ..DeviceSpec::default() },
        rules: Rules { keep_box: None, unseen: true, in_front: true, margin: 0.05, isolated: 0.0 },
        rounds: 1,
        refine: 0,
        seed: 0,
        output: &output,
    };
    let clean_until = |after: usize| {
        let observer = Stopping { questions: Cell::new(0), after };
        (clean(&options, &observer), observer.questions.get())
    };
    // Test views before and after, and training views in between.
    let test_views = VIEWS.div_ceil(8);
    let views = VIEWS + test_views;
    let (cleaned, questions) = clean_until(usize::MAX);
    assert!(cleaned.is_ok() && questions == views, "{questions}: {cleaned:?}");
    for after in [0, test_views + 1, views - 1] {
        let (cleaned, questions) = clean_until(after);
        let failure = cleaned.expect_err("stopped");
        assert_eq!((failure.code, questions), (130, after + 1), "{failure}");
        assert!(failure.to_string().contains("stopped by SIGINT"), "{failure}");
    }
    assert!(!output.exists());
}
