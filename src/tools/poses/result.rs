//! Takes the best model, writes its scene, and says what became of each photograph.

use std::collections::HashMap;
use std::path::Path;

use crate::attempts::{Candidate, MIN_VIEWS, Task};
use crate::error::PosesError;
use crate::scene::{self, Report};
use crate::{Found, Options, upright};
use densify_data::dataset::Photographs;
use densify_run::Observer;

/// Names that a line lists at most.
const LISTED: usize = 5;

/// The candidate with most accepted views, if it has enough; names the others.
pub(crate) fn best(
    candidates: Vec<Candidate>,
    count: usize,
    observer: &dyn Observer,
) -> Result<Candidate, PosesError> {
    let mut candidates = candidates.into_iter();
    let Some(best) = candidates.next() else { return Err(PosesError::NothingInCommon { count }) };
    if best.accepted() < MIN_VIEWS {
        let registered = best.model.images.len();
        let why = match best.verdict.contradicted {
            0 => "no photographs confirm each other's poses".to_owned(),
            contradicted => format!("matches contradict {contradicted} of their poses"),
        };
        return Err(PosesError::Contradicted { registered, count, why });
    }
    let names: Vec<&str> = best.model.images.iter().map(|image| &*image.name).collect();
    for other in candidates {
        let apart = other.model.images.iter().all(|image| !names.contains(&&*image.name));
        if apart && other.accepted() >= MIN_VIEWS {
            observer.say(format_args!(
                "note     {} photographs form a scene of their own and are not used; to train on it, put them into a \
                 folder of their own",
                other.accepted()
            ));
        }
    }
    Ok(best)
}

/// Writes the scene of a candidate, and says what became of each photograph.
pub(crate) fn finish(
    options: &Options,
    (best, mut report): (Candidate, Report),
    (photographs, task): (&Photographs, &Task<'_>),
    observer: &dyn Observer,
) -> Result<Found, PosesError> {
    let Candidate { mut model, verdict, origin } = best;
    let place: HashMap<&str, usize> =
        task.names.iter().enumerate().map(|(at, name)| (&**name, at)).collect();
    let photograph = |name: &str| &photographs.all[place[name]];
    let mut is_placed = vec![false; photographs.all.len()];
    let mut kept: Vec<String> = Vec::new();
    for (image, reason) in model.images.iter().zip(&verdict.reasons) {
        is_placed[place[&*image.name]] = true;
        let name = photograph(&image.name).name.clone();
        match reason {
            None => kept.push(image.name.clone()),
            Some(reason) => report.rejected.push((name, reason.to_string())),
        }
    }
    model.retain(|image| kept.contains(&image.name));
    let unplaced = photographs.all.iter().zip(&is_placed).filter(|(_, placed)| !**placed);
    report.unplaced = unplaced.map(|(photograph, _)| photograph.name.clone()).collect();
    if !options.keep_frame {
        let cameras = model
            .images
            .iter()
            .map(|image| (image.rotation, image.centre(), photograph(&image.name).up));
        model.turn(upright::upright_from_world(cameras));
        observer.say(format_args!(
            "upright  turned by the cameras' up directions: up is -y (--keep-frame: not turned)"
        ));
    }
    let mut pictures = Vec::new();
    for image in &mut model.images {
        let photograph = photograph(&image.name);
        let to = Path::new("images").join(&photograph.name);
        pictures.push((photographs.folder.join(&photograph.name), to));
        if let Some(mask) = &photograph.mask {
            pictures
                .push((mask.clone(), Path::new("masks").join(format!("{}.png", photograph.name))));
        }
        image.name.clone_from(&photograph.name);
        report.accepted.push(photograph.name.clone());
    }
    report.origin = origin;
    scene::write((&model, &report), &pictures, (&task.work.join("scene"), &options.output))?;
    tell(&report, photographs.all.len(), observer);
    Ok(Found { photographs: photographs.all.len(), accepted: report.accepted.len() })
}

/// Says how many photographs are in the scene, and why the others are not.
fn tell(report: &Report, count: usize, observer: &dyn Observer) {
    let rejected: Vec<String> =
        report.rejected.iter().map(|(name, why)| format!("{name} ({why})")).collect();
    for (what, names) in [("rejected", &rejected), ("unplaced", &report.unplaced)] {
        if !names.is_empty() {
            let more = if names.len() > LISTED { ", …" } else { "" };
            let shown = names[..names.len().min(LISTED)].join(", ");
            observer.say(format_args!("{what} {} of {count}: {shown}{more}", names.len()));
        }
    }
}
