//! `--sh-degree`: how colours may depend on the direction of view, and who decides it.

use std::ops::RangeInclusive;
use std::str::FromStr;

use super::TrainArgs;
use super::size::Budget;
use crate::cli::failure::Failure;
use crate::cli::number::grouped;
use crate::dataset::Dataset;
use crate::gaussians::MAX_SH_DEGREE;
use crate::output::{DegreeChoice, RunConfig};
use crate::spread::{self, MIN_TRACKS};

/// What is given with `--sh-degree`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ShDegree {
    /// This one.
    Fixed(u8),
    /// As the scene requires.
    Auto,
}

impl FromStr for ShDegree {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word.parse() {
            Ok(degree) if degree <= MAX_SH_DEGREE => Ok(Self::Fixed(degree)),
            _ if word == "auto" => Ok(Self::Auto),
            _ => Err(format!("`{word}` is no degree; give 0, 1, 2, 3, or auto")),
        }
    }
}

/// Fails where `--full` and something that leaves out are both given.
pub(super) fn check_full(args: &TrainArgs) -> Result<(), Failure> {
    if args.full && args.budget == Some(Budget::Auto) {
        return Err(Failure::input(
            "--full leaves nothing out, --budget auto leaves out what does not pay; give one of the two, \
             or --full with a number of rows",
        ));
    }
    if args.full && args.sh_degree == Some(ShDegree::Auto) {
        return Err(Failure::input(
            "--full leaves nothing out, --sh-degree auto leaves out what the scene does not require; \
             give one of the two, or --full with --sh-degree 3",
        ));
    }
    Ok(())
}

/// The degree of a run, before its memory is known.
#[derive(Debug, Clone)]
pub(super) struct Degree {
    /// The highest wanted, and how far memory may lower it.
    pub(super) range: RangeInclusive<u8>,
    /// Who decided it.
    pub(super) choice: DegreeChoice,
    /// Bytes that deciding it took beside an image.
    pub(super) bytes: u64,
}

impl Degree {
    pub(super) fn highest(&self) -> u8 {
        *self.range.end()
    }

    /// Decides it: from the configuration of a run that goes on, else as the options say, else from
    /// the tracks of the dataset where it has enough.
    pub(super) fn decide(
        args: &TrainArgs,
        saved: Option<&RunConfig>,
        dataset: &Dataset,
    ) -> Result<Self, Failure> {
        if let Some(RunConfig { train, .. }) = saved {
            let degree = match args.sh_degree {
                Some(ShDegree::Fixed(degree)) => degree,
                Some(ShDegree::Auto) if train.sh_degree_from == DegreeChoice::Given => {
                    return Err(Failure::input(format!(
                        "--sh-degree auto contradicts the run that goes on, which was given degree {}; \
                         leave it out, or begin a new run without --resume",
                        train.sh_degree
                    )));
                }
                _ => train.sh_degree,
            };
            return Ok(Self { range: degree..=degree, choice: train.sh_degree_from, bytes: 0 });
        }
        let given = |range| Self { range, choice: DegreeChoice::Given, bytes: 0 };
        match args.sh_degree {
            Some(ShDegree::Fixed(degree)) => Ok(given(degree..=degree)),
            None if args.full => Ok(given(MAX_SH_DEGREE..=MAX_SH_DEGREE)),
            None => Ok(given(0..=MAX_SH_DEGREE)),
            Some(ShDegree::Auto) => {
                let bytes = dataset.tracks.bytes() + spread::bytes(&dataset.tracks);
                let found = match dataset.tracks.len() {
                    ..MIN_TRACKS => None,
                    _ => Some(spread::measure(&dataset.tracks, &dataset.train)?),
                };
                let decided = found.and_then(|found| Some((found.degree()?, found)));
                let (degree, choice) = match decided {
                    Some((degree, spread)) => (degree, DegreeChoice::Spread(spread)),
                    None => (MAX_SH_DEGREE, DegreeChoice::Undecided),
                };
                Ok(Self { range: 0..=degree, choice, bytes })
            }
        }
    }

    /// What there is to say about it, if anything.
    pub(super) fn line(&self) -> Option<String> {
        match self.choice {
            DegreeChoice::Given => None,
            DegreeChoice::Spread(found) => Some(format!(
                "colour   degree {} (auto): between their views a twentieth of {} points differ by {:.1}/255 or \
                 more",
                self.highest(),
                grouped(found.tracks),
                found.twentieth,
            )),
            DegreeChoice::Undecided => Some(format!(
                "colour   degree {} (auto): points of a reconstruction decide nothing, as fewer than \
                 {MIN_TRACKS} are known in enough views, or fewer than half of them lie on surfaces",
                self.highest()
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degrees_are_numbers_or_auto() {
        assert_eq!("2".parse(), Ok(ShDegree::Fixed(2)));
        assert_eq!("auto".parse(), Ok(ShDegree::Auto));
        for bad in ["4", "-1", "Auto", ""] {
            let message = bad.parse::<ShDegree>().unwrap_err();
            assert!(message.contains("auto"), "{message}");
        }
    }
}
