//! Tests of whole datasets: generated good and bad ones, and real ones if available.

mod archives;
mod bad_input;
mod exif;
mod formats;
mod lenses;
mod phones;
mod realitycapture;
mod shared;

use super::{Dataset, LoadOptions, Note};
use densify_fixtures::Made;

impl Note {
    /// Whether the note names no option and contains these words.
    fn contains(&self, words: &str) -> bool {
        matches!(self, Self::Text(text) if text.contains(words))
    }
}

fn load(made: &Made) -> Dataset {
    load_with(made, &LoadOptions::default())
}

fn load_with(made: &Made, options: &LoadOptions) -> Dataset {
    Dataset::load(made.path(), options).unwrap_or_else(|e| panic!("{e}"))
}

/// Loads a broken dataset; the message or the remedy must contain all of `words`, which are separated by commas.
fn refused(case: &str, made: &Made, options: &LoadOptions, words: &str) {
    let Err(error) = Dataset::load(made.path(), options) else { panic!("{case}: it loaded") };
    let message = format!("{error}: {error:?}");
    for word in words.split(", ") {
        assert!(message.contains(word), "{case}: {word:?} is not in: {message}");
    }
}
