//! Tests of declarations: their ranges and derived values.

use super::*;

#[test]
fn numbers_out_of_range_are_refused() {
    assert_eq!(Needs::default().check(), Ok(()));
    let noise = NoiseTerm { strength: 1.0, sharpness: 100.0, opacity: 0.005 };
    let mask = MaskTerm { start: 1.0, rate: 0.01, weight: 5e-4, threshold: 0.01 };
    assert_eq!(Needs { mask: Some(mask), ..Needs::default() }.check(), Ok(()));
    let score = |error_score| Needs { error_score, ..Needs::default() };
    let rates = |rates| Needs { rates, ..Needs::default() };
    let fade =
        |from, to| rates(RateOverrides { fade: Some(Fade { from, to }), ..Default::default() });
    let map =
        |map| Needs { aux: Some(AuxRequest { map, ..Default::default() }), ..Needs::default() };
    let wrong = [
        Needs { loss_terms: LossTerms { opacity: -1.0, scale: 0.0 }, ..Needs::default() },
        Needs { loss_terms: LossTerms { opacity: 0.0, scale: f32::NAN }, ..Needs::default() },
        Needs { noise: Some(NoiseTerm { strength: f32::INFINITY, ..noise }), ..Needs::default() },
        Needs { signals: SignalSet::from([Signal::Mask]), ..Needs::default() },
        Needs { mask: Some(MaskTerm { start: f32::NAN, ..mask }), ..Needs::default() },
        Needs { mask: Some(MaskTerm { rate: 0.0, ..mask }), ..Needs::default() },
        Needs { mask: Some(MaskTerm { weight: -1.0, ..mask }), ..Needs::default() },
        Needs { mask: Some(MaskTerm { threshold: 1.0, ..mask }), ..Needs::default() },
        Needs { mask: Some(mask), cadence: Cadence { all: 2, sh_rest: 1 }, ..Needs::default() },
        Needs { cadence: Cadence { all: 0, sh_rest: 1 }, ..Needs::default() },
        Needs { cadence: Cadence { all: 1, sh_rest: 0 }, ..Needs::default() },
        rates(RateOverrides { quat: Some(Rate { start: 1.0, end: 0.0 }), ..Default::default() }),
        fade(1.0, 0.5),
        score(ErrorScore { power: 0.0, ..ErrorScore::default() }),
        score(ErrorScore { edge: f32::NAN, ..ErrorScore::default() }),
        score(ErrorScore { footprint: 1.5, ..ErrorScore::default() }),
        score(ErrorScore { view_power: 0.0, ..ErrorScore::default() }),
        Needs { least_resolution: Some(0.0), ..Needs::default() },
        Needs { least_resolution: Some(1.5), ..Needs::default() },
        Needs { least_resolution: Some(f64::NAN), ..Needs::default() },
        fade(0.5, 0.0),
        Needs { start: StartRule { opacity: Some(1.0), scale: 1.0 }, ..Needs::default() },
        Needs { start: StartRule { opacity: None, scale: 0.0 }, ..Needs::default() },
        map(PixelMap { error: -1.0, ..PixelMap::default() }),
        map(PixelMap { threshold: 1.0, ..PixelMap::default() }),
    ];
    for needs in wrong {
        assert!(needs.check().is_err(), "{needs:?}");
    }
}

#[test]
fn the_score_of_a_view_depends_on_error_footprint_and_power() {
    let score = ErrorScore { footprint: 0.5, view_power: 0.5, ..ErrorScore::default() };
    // 8 / √4 = 4, whose root is 2.
    assert!((score.of_view(8.0, 4.0) - 2.0).abs() < 1e-6);
    assert!((ErrorScore::default().of_view(8.0, 4.0) - 8.0).abs() < 1e-6);
    let unscored = [(0.0, 4.0), (8.0, 0.0), (f32::NAN, 4.0)];
    assert!(unscored.iter().all(|&(error, weight)| score.of_view(error, weight).to_bits() == 0));
}

#[test]
fn resolutions_must_be_within_the_declared_range() {
    let needs = Needs { least_resolution: Some(0.3), ..Needs::default() };
    assert!([0.3, 0.5, 1.0].iter().all(|&factor| needs.check_resolution(factor).is_ok()));
    let wrong = [0.29, 1.01, f64::NAN, -0.5];
    assert!(wrong.iter().all(|&factor| needs.check_resolution(factor).is_err()));
    let whole = Needs::default();
    assert!(whole.check_resolution(1.0).is_ok() && whole.check_resolution(0.99).is_err());
}

#[test]
fn the_optimiser_steps_at_multiples_of_the_cadence() {
    let due = |cadence: Cadence, class: usize| -> Vec<u32> {
        (1..=12).filter(|&step| cadence.steps_at(step)[class]).collect()
    };
    assert_eq!(due(Cadence::default(), 0).len(), 12);
    let sh = Cadence { all: 1, sh_rest: 4 };
    assert_eq!((due(sh, 0).len(), due(sh, 1)), (12, vec![4, 8, 12]));
    // Bands 1–3 never step more often than the other parameters.
    let all = Cadence { all: 5, sh_rest: 1 };
    assert_eq!((due(all, 0), due(all, 1)), (vec![5, 10], vec![5, 10]));
    assert!(sh.is_within(sh) && !sh.is_within(Cadence::default()));
    assert!(!sh.is_within(all) && !all.is_within(sh));
    assert!(Cadence::default().is_within(all) && all.is_within(Cadence { all: 2, sh_rest: 1 }));
    assert!(Cadence { all: 4, sh_rest: 3 }.is_within(all));
    assert!(!Cadence { all: 0, sh_rest: 1 }.is_within(all));
}

#[test]
fn noise_is_halved_at_its_opacity() {
    let noise = NoiseTerm { strength: 1.0, sharpness: 100.0, opacity: 0.005 };
    assert!((noise.share(0.005) - 0.5).abs() < 1e-6);
    // σ(−100·(0.1 − 0.005)) = σ(−9.5).
    assert!((noise.share(0.1) / 7.484_62e-5 - 1.0).abs() < 1e-4);
}

#[test]
fn scenes_with_few_views_are_trained_with_l1() {
    let [few, enough] = [39, 40].map(PixelLoss::for_views);
    assert_eq!((few, enough), (PixelLoss::L1, PixelLoss::Huber));
    assert!(few.bound() == 0.0 && enough.bound() > 0.0);
    for views in [39, 40] {
        assert_eq!(PixelLossChoice::Auto.term(views), PixelLoss::for_views(views));
        assert_eq!(PixelLossChoice::L1.term(views), PixelLoss::L1);
        assert_eq!(PixelLossChoice::Huber.term(views), PixelLoss::Huber);
        for choice in [PixelLossChoice::Auto, PixelLossChoice::L1, PixelLossChoice::Huber] {
            let decided = choice.decided(views);
            assert!(decided != PixelLossChoice::Auto);
            assert_eq!(decided.term(100 - views), choice.term(views));
        }
    }
}
