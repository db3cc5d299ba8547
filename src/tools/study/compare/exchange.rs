//! Results in the formats of two public collections, as the folder `results` of the study.
//!
//! ```text
//! results/nerfbaselines/seedN/SCENE/POLICY-LIMIT.json   a file per run, as `nerfbaselines evaluate` writes it
//! results/3dgs.zip/SCENE.csv                            a row per policy and limit, means over seeds
//! ```
//!
//! NerfBaselines (Kulhanek and Sattler 2024) reads scores of single views as base64 of little-endian 32-bit floats. It
//! takes a scene of a method once, hence the folders by seed. 3DGS.zip (Bagdasarian et al. 2024) reads a CSV per scene.
//! Both compare methods under conventions of their own (resolution, test views, 30,000 iterations): the files carry the
//! numbers, not the claim that these were kept.

use std::collections::BTreeMap;
use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Map, Value, json};

use super::policy_variant::PolicyVariant;
use super::{Outcome, outcomes_at, scenes_and_limits};
use crate::difference::mean;
use densify_core::files::{FileError, write_atomically};
use densify_train::output::{Mean, write_json};

/// The columns of 3DGS.zip.
const COLUMNS: &str = "Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians";

/// Writes both into the folder `results`.
pub(super) fn write(
    output: &Path,
    outcomes: &[Outcome],
    policies: &[String],
) -> Result<(), FileError> {
    let folder = output.join("results");
    for run in outcomes {
        let name = format!("{}.json", method(run));
        let place = format!("nerfbaselines/seed{}/{}", run.seed, run.scene);
        write_json(&folder.join(place).join(name), &nerfbaselines(run))?;
    }
    let mut tables: BTreeMap<&str, String> = BTreeMap::new();
    for (scene, limit) in scenes_and_limits(outcomes) {
        let table = tables.entry(scene).or_insert_with(|| format!("{COLUMNS}\n"));
        let here = outcomes_at(outcomes, scene, limit);
        for policy in policies {
            let runs: Vec<&Outcome> =
                here.iter().filter(|r| r.factor == *policy).copied().collect();
            if let Some(first) = runs.first() {
                *table += &format!("-{},{}\n", method(first), cells(&runs));
            }
        }
    }
    for (scene, table) in tables {
        let path = folder.join("3dgs.zip").join(format!("{scene}.csv"));
        write_atomically(&path, |out| out.write_all(table.as_bytes()))?;
    }
    Ok(())
}

/// Policy, parameters and limit in a word.
fn method(run: &Outcome) -> String {
    format!("{}-{}", PolicyVariant::parse(&run.factor).folder(), run.limit().word())
}

/// Means over runs of PSNR, SSIM, LPIPS, bytes and rows; what was not measured is empty.
fn cells(runs: &[&Outcome]) -> String {
    let over_runs = |value: fn(&Outcome) -> Option<f64>, digits: usize| {
        let values = runs.iter().map(|run| value(run)).collect::<Option<Vec<f64>>>();
        values.and_then(mean).map_or_else(String::new, |mean| format!("{mean:.digits$}"))
    };
    [
        over_runs(|run| Some(run.psnr), 4),
        over_runs(|run| Some(run.ssim), 6),
        over_runs(|run| run.lpips, 6),
        over_runs(|run| Some(run.model_bytes? as f64), 0),
        over_runs(|run| Some(run.rows as f64), 0),
    ]
    .join(",")
}

/// The results of a run as `nerfbaselines evaluate` writes them, without the checksums of pictures, which were not kept,
/// and with FLIP as a further metric.
fn nerfbaselines(run: &Outcome) -> Value {
    type Score = fn(&Mean) -> Option<f64>;
    let (mut metrics, mut raw) = (Map::new(), Map::new());
    let scores: [(&str, Score); 4] = [
        ("psnr", |view| Some(view.psnr)),
        ("ssim", |view| Some(view.ssim)),
        ("lpips", |view| view.lpips),
        ("flip", |view| Some(view.flip)),
    ];
    for (name, score) in scores {
        let values = run.views.values().map(score).collect::<Option<Vec<f64>>>();
        let Some(values) = values else { continue };
        if let Some(mean) = mean(values.iter().copied()) {
            metrics.insert(name.to_owned(), json!((mean * 1e5).round() / 1e5));
            raw.insert(name.to_owned(), encoded(&values).into());
        }
    }
    let mib = run.peak_bytes.map(|bytes| bytes >> 20);
    json!({
        "nb_info": {
            "method": format!("densify:{}", method(run)),
            "num_iterations": run.iterations,
            "total_train_time": run.seconds,
            "resources_utilization": { "memory": mib },
            "config_overrides": run.spec,
            "dataset_metadata": dataset(run),
            "evaluation_protocol": "default",
            "densify_version": run.densify,
            "seed": run.seed,
            "num_gaussians": run.rows,
        },
        "render_dataset_metadata": dataset(run),
        "metrics": metrics,
        "metrics_raw": raw,
        "evaluation_protocol": "default",
    })
}

fn dataset(run: &Outcome) -> Value {
    json!({ "id": "densify", "scene": run.scene, "evaluation_protocol": "default" })
}

/// Numbers as NerfBaselines stores them.
fn encoded(values: &[f64]) -> String {
    let bytes: Vec<u8> = values.iter().flat_map(|value| (*value as f32).to_le_bytes()).collect();
    STANDARD.encode(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::sample;

    fn run(policy: &str, seed: u32, psnr: [f64; 2]) -> Outcome {
        let view = |psnr| Mean { psnr, ssim: 0.5, flip: 0.25, lpips: None, fitted: None };
        let views = ["a.png", "b.png"].map(String::from).into_iter().zip(psnr.map(view)).collect();
        let model_bytes = Some(1000 + u64::from(seed));
        Outcome { views, model_bytes, ..sample(policy, "1000", seed, 30.0 + f64::from(seed)) }
    }

    #[test]
    fn both_forms_have_the_scores() {
        let root = tempfile::tempdir().unwrap();
        let all = [
            run("diet:rho=0", 0, [30.0, 31.5]),
            run("diet:rho=0", 1, [31.0, 31.0]),
            run("igs", 0, [1.0, 2.0]),
        ];
        write(root.path(), &all, &["diet:rho=0", "igs"].map(String::from)).unwrap();
        let read =
            |name: &str| std::fs::read_to_string(root.path().join("results").join(name)).unwrap();
        let table = "Submethod,PSNR,SSIM,LPIPS,Size [Bytes],#Gaussians\n\
                     -diet-rho-0-1000,30.5000,0.305000,,1000,900\n\
                     -igs-1000,30.0000,0.300000,,1000,900\n";
        // Half a byte more is rounded to even.
        assert_eq!(read("3dgs.zip/room.csv"), table);
        let file: Value =
            serde_json::from_str(&read("nerfbaselines/seed0/room/diet-rho-0-1000.json")).unwrap();
        assert_eq!(file["metrics"], json!({ "psnr": 30.75, "ssim": 0.5, "flip": 0.25 }));
        assert_eq!(file["nb_info"]["method"], "densify:diet-rho-0-1000");
        assert_eq!(file["render_dataset_metadata"]["scene"], "room");
        let bytes = STANDARD.decode(file["metrics_raw"]["psnr"].as_str().unwrap()).unwrap();
        assert_eq!(bytes, [30.0_f32.to_le_bytes(), 31.5_f32.to_le_bytes()].concat());
        assert!(file["metrics_raw"].get("lpips").is_none(), "{file}");
    }
}
