//! `densify clean`: what it removes and reports, and refused calls.

use densify::core::gaussians::{Gaussians, logit, rgb_to_dc};
use densify::data::models::PLY;

use super::{call, gaussians, read, scratch, text, train};
use crate::photographs::Photographs;

#[test]
fn floaters_go_and_the_model_stays() {
    let scene = Photographs::colmap_text();
    let (root, run) = scratch();
    train(scene.path(), &run, 60, "--budget 300 --eval --quiet").ok();
    let model = run.join("point_cloud/iteration_60/point_cloud.ply");
    let original = read(&model);
    // Ten Gaussians that no view shows, because they are as good as transparent.
    let mut changed: Gaussians = gaussians(&model);
    let rows = changed.len();
    let mut extra = Gaussians::zeros(10, 0).with_degree(changed.sh_degree);
    extra.antialiasing = changed.antialiasing;
    extra.quats.fill([1.0, 0.0, 0.0, 0.0]);
    extra.log_scales.fill([-5.0; 3]);
    extra.opacity_logits.fill(logit(1e-4));
    extra.sh.fill(rgb_to_dc(0.5));
    changed.append(extra);
    let with_unseen = root.path().join("unseen.ply");
    PLY.save(&changed, &with_unseen).expect("a model");
    let clean = |from: &std::path::Path, name: &str, flags: &str| {
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

    let path = text(&model);
    for (from, name, flags, words) in [
        (&model, "d.ply", "", &["no photographs", "--scene DIR"][..]),
        (&run, "d.xyz", "", &["-o:", "--format"]),
        (&run, "a.ply", "", &["a.ply exists", "--overwrite"]),
        (&run, "d.ply", "--margin 1.5", &["--margin"]),
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
