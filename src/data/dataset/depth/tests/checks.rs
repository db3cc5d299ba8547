//! Tests of what is refused, left out, corrected or fitted.

use super::*;

#[test]
fn depth_that_densify_rendered_is_used_only_on_request() {
    let room = Room::new();
    let choices = |choice| with(DepthOptions { choice, ..on() });
    for (choice, is_used) in
        [(DepthChoice::Auto, false), (DepthChoice::Off, false), (DepthChoice::On, true)]
    {
        let data = room.load(&choices(choice)).unwrap();
        assert_eq!(data.depth.is_some(), is_used, "{choice:?}");
        assert_eq!(data.train.iter().any(|view| view.source.depth.is_some()), is_used);
        assert!(!data.notes.iter().any(|note| matches!(note, Note::DepthLeftOut(_))));
    }
    std::fs::remove_file(room.path().join("scene.json")).unwrap();
    assert!(room.load(&choices(DepthChoice::Auto)).unwrap().depth.is_some());
}

#[test]
fn depth_that_disagrees_with_the_points_is_refused_or_left_out() {
    let at = |values: &Values, [x, y]: [u32; 2]| values[(x, y)].0[0];
    // The field of view of the room's cameras follows from the file of poses.
    let focal = {
        let text = std::fs::read_to_string(ROOM.path().join("transforms_train.json")).unwrap();
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        json["fl_x"].as_f64().unwrap() as f32
    };
    let ray = |[x, y]: [u32; 2]| {
        let along = |i: u32| (i as f32 + 0.5 - 0.5 * SIDE as f32) / focal;
        (along(x).powi(2) + along(y).powi(2) + 1.0).sqrt()
    };
    let refusal = |change: &dyn Fn(usize, [u32; 2], &Values) -> f32| {
        let room = Room::new();
        room.edit(change).refusal(on())
    };
    let (problem, remedy) = refusal(&|_, pixel, values| 1000.0 * at(values, pixel));
    assert!(
        problem.contains("times that of") && problem.contains("unit of 0.000001 would fit"),
        "{problem}"
    );
    assert_eq!(remedy, Some(DepthRemedy::Unit));
    let (problem, remedy) = refusal(&|_, pixel, values| at(values, pixel) / 5.0);
    assert!(problem.contains("0.2") && problem.contains("e-3 would fit"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Unit));
    let (problem, remedy) = refusal(&|_, pixel, values| ray(pixel) * at(values, pixel));
    assert!(problem.contains("along rays") && problem.contains(".npy"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::AlongRay));
    let (problem, remedy) = refusal(&|_, pixel, values| 9.0 / at(values, pixel));
    assert!(problem.contains("inverse depth"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Relative));
    let (problem, remedy) = refusal(&|_, [x, y], values| at(values, [x.saturating_sub(3), y]));
    assert!(problem.contains("(3, 0) px"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Register));
    let (problem, remedy) = refusal(&|_, _, _| 0.0);
    assert!(problem.contains("no depth is known in any of 8"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
    let (problem, _) = refusal(&|_, _, _| f32::INFINITY);
    assert!(problem.contains("no depth is known"), "{problem}");
    let (problem, remedy) = refusal(&|_, _, _| 4.0);
    assert!(problem.contains("only one value"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
    let (problem, remedy) = refusal(&|_, pixel, values| -at(values, pixel));
    assert!(problem.contains("most depths of the 8 checked views are negative"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
}

#[test]
fn maps_of_other_views_are_refused() {
    let room = Room::new();
    let maps: Vec<Values> = room.arrays().iter().map(|path| stored(path)).collect();
    let rotated = Room::new();
    rotated.edit(|view, [x, y], _| maps[(view + 1) % 8][(x, y)].0[0] / 1000.0);
    let (problem, remedy) = rotated.refusal(on());
    assert!(problem.contains("other views"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::OtherViews));
    let turned = Room::new();
    turned.edit(|view, [x, y], _| maps[view][(SIDE - 1 - x, SIDE - 1 - y)].0[0] / 1000.0);
    assert_eq!(turned.refusal(on()).1, Some(DepthRemedy::OtherViews));
}

#[test]
fn maps_of_thin_layers_agree_with_points_that_are_mostly_hidden() {
    let layers = Room::layers();
    let finding = layers.load(&with(on())).unwrap().depth.unwrap();
    assert!((finding.scale - 1.0).abs() < 0.1 && finding.points > 500, "{finding:?}");
    let maps: Vec<Values> = layers.arrays().iter().map(|path| stored(path)).collect();
    layers.edit(|view, [x, y], _| maps[(view + 1) % 8][(x, y)].0[0] / 1000.0);
    assert_eq!(layers.refusal(on()).1, Some(DepthRemedy::OtherViews));
}

#[test]
fn negative_values_and_constant_maps_cost_only_themselves() {
    let room = Room::new();
    room.edit(|view, [x, y], values| match view {
        2 if x < 9 => -1.0,
        5 => 4.0,
        _ => values[(x, y)].0[0],
    });
    let data = room.load(&with(on())).unwrap();
    assert_eq!(data.depth.as_ref().unwrap().views, 7);
    let noted = |note: &Note| note.contains("1 of 8 checked depth maps have only one value");
    assert!(data.notes.iter().any(noted), "{:?}", data.notes);
    assert!(data.train[5].source.depth.is_none());
    let map = data.train[2].source.load_depth().unwrap().unwrap();
    let row = (20 * SIDE) as usize;
    assert!(map.inverse[row..row + 8].iter().all(|x| *x == 0) && map.inverse[row + 30] > 0);
}

#[test]
fn confidences_may_have_16_bits_but_must_not_all_be_0() {
    let room = Room::new();
    let path = |array: &Path| {
        room.path().join(format!("confidence/train/{}.png", array.file_stem().unwrap().display()))
    };
    let write = |level: u16| {
        for array in room.arrays() {
            let path = path(&array);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            image::ImageBuffer::from_pixel(SIDE, SIDE, image::Luma([level])).save(&path).unwrap();
        }
    };
    write(2);
    let data = room.load(&with(on())).unwrap();
    let map = data.train[0].source.load_depth().unwrap().unwrap();
    assert!(map.confidence.contains(&255));
    write(0);
    let (problem, remedy) = room.refusal(on());
    assert!(problem.contains("all confidences are 0"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::Repair));
}

#[test]
fn faults_of_depth_do_not_end_runs_without_depth() {
    let room = Room::new();
    let list = room.path().join("transforms_train.json");
    let text = std::fs::read_to_string(&list).unwrap();
    let mut json: serde_json::Value = serde_json::from_str(&text).unwrap();
    for (name, value) in [
        ("depth_file_path", serde_json::json!(7)),
        ("depth_file_path", serde_json::json!("scene.txt")),
        ("depth_file_path", serde_json::json!("../../depth.npy")),
    ] {
        json["frames"][0][name] = value;
        std::fs::write(&list, json.to_string()).unwrap();
        std::fs::write(room.path().join("scene.txt"), "").unwrap();
        assert_eq!(room.refusal(on()).1, Some(DepthRemedy::LeaveOut), "{name}");
        let off = room.load(&LoadOptions::default()).unwrap();
        assert!(!off.notes.iter().any(|note| matches!(note, Note::DepthLeftOut(_))));
    }
}

#[test]
fn a_map_damaged_after_the_checks_costs_the_depth_of_its_view() {
    let room = Room::new();
    let [tolerant, strict] = [true, false]
        .map(|drops_damaged| room.load(&with(DepthOptions { drops_damaged, ..on() })).unwrap());
    std::fs::write(&room.arrays()[3], b"\x93NUMPY\x01\x00").unwrap();
    assert!(strict.train[3].source.load_depth().unwrap_err().to_string().contains(".npy"));
    assert_eq!(strict.take_depth_faults(), []);
    for _ in 0..2 {
        assert_eq!(tolerant.train[3].source.load_depth(), Ok(None));
    }
    assert!(tolerant.train[2].source.load_depth().unwrap().is_some());
    let faults = tolerant.take_depth_faults();
    assert!(matches!(&faults[..], [Note::DepthDropped(_)]), "{faults:?}");
}

#[test]
fn along_rays_and_small_errors_in_scale_are_corrected() {
    let room = Room::new();
    let truth = stored(&room.arrays()[5]);
    room.edit(|_, [x, y], values| 1.07 * values[(x, y)].0[0]);
    let data = room.load(&with(on())).unwrap();
    let found = data.depth.as_ref().unwrap();
    assert!((found.scale - 1.07).abs() < 0.01 && found.is_corrected, "{found:?}");
    let noted = |note: &Note| note.contains("% too large");
    assert!(data.notes.iter().any(noted), "{:?}", data.notes);
    let (worst, _) = error(&data, 5, |x, y| truth[(x, y)].0[0] / 1000.0);
    assert!(worst < 0.01, "{worst}");
    // Read as distances along rays, the same values are refused as what they are.
    let (problem, remedy) = room.refusal(DepthOptions { along: DepthAlong::Ray, ..on() });
    assert!(problem.contains("optical axis"), "{problem}");
    assert_eq!(remedy, Some(DepthRemedy::AlongAxis));
}

#[test]
fn relative_depth_is_fitted_to_each_view() {
    let room = Room::new();
    let truth: Vec<Values> = room.arrays().iter().map(|path| stored(path)).collect();
    room.edit(|view, [x, y], values| {
        let (scale, offset) = (3.0 + view as f32, 0.1 * view as f32);
        scale / values[(x, y)].0[0] + offset
    });
    let options = DepthOptions { unit: Some(DepthUnit::Relative), ..on() };
    let data = room.load(&with(options.clone())).unwrap();
    assert_eq!(data.depth.as_ref().unwrap().source, DepthOrigin::RelativeMaps);
    let mut fitted = 0;
    for view in 0..8 {
        // A view of a bare wall does not determine a scale.
        let Some(map) = data.train[view].source.load_depth().unwrap() else { continue };
        fitted += 1;
        let mut errors: Vec<f32> = (0..map.inverse.len())
            .filter(|&pixel| map.inverse_depth(pixel)[1] > 0.0)
            .map(|pixel| {
                let world = 1.0 / map.inverse_depth(pixel)[0] / data.normalisation.scale as f32;
                let truth = truth[view].as_raw()[pixel] / 1000.0;
                (world / truth - 1.0).abs()
            })
            .collect();
        errors.sort_by(f32::total_cmp);
        assert!(errors[errors.len() / 2] < 0.05, "view {view}: {}", errors[errors.len() / 2]);
    }
    assert!(fitted >= 7, "{fitted}");
    // Depth itself is not inverse depth.
    let room = Room::new();
    assert_eq!(room.refusal(options).1, Some(DepthRemedy::NotRelative));
}

#[test]
fn noise_is_no_edge() {
    let known = |noise: f32| {
        let room = Room::new();
        room.edit(|view, [x, y], values| {
            let mixed =
                (view as u64 * 7919 + u64::from(y * SIDE + x)).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let unit = (mixed >> 40) as f32 / 16_777_216.0;
            values[(x, y)].0[0] * (1.0 + noise * (unit - 0.5))
        });
        room.load(&with(on())).unwrap().depth.unwrap().known
    };
    let (clean, noisy) = (known(0.0), known(0.2));
    assert!(noisy > 0.9 * clean && noisy < 0.99, "{noisy} with noise, {clean} without");
}
