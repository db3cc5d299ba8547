//! Tests of whole datasets: generated good and bad ones, and real ones if available.

mod archives;
mod bad_input;
mod colmap;
mod exif;
mod formats;
mod lenses;
mod masks;
mod phones;
mod realitycapture;
mod shared;
mod transforms;
mod unposed;

use std::path::Path;

use super::{Dataset, LoadOptions, Note, View};
use densify_fixtures::{Made, SIZE};

impl Note {
    /// Returns true if the note names no option and contains these words.
    pub(crate) fn contains(&self, words: &str) -> bool {
        matches!(self, Self::Text(text) if text.contains(words))
    }
}

pub(crate) fn load(made: &Made) -> Dataset {
    load_with(made, &LoadOptions::default())
}

fn load_with(made: &Made, options: &LoadOptions) -> Dataset {
    Dataset::load(made.path(), options).unwrap_or_else(|e| panic!("{e}"))
}

fn names(views: &[View]) -> Vec<&str> {
    views.iter().map(|view| view.name.as_str()).collect()
}

/// Fails unless a note contains all of `words`, which are separated by commas.
pub(crate) fn assert_noted(data: &Dataset, words: &str) {
    let is_noted = |note: &Note| words.split(", ").all(|word| note.contains(word));
    assert!(data.notes.iter().any(is_noted), "{words}: {:?}", data.notes);
}

/// Writes a mask of the photographs' usual size, with these weights by column.
fn write_mask(path: &Path, weight: impl Fn(u32) -> u8) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    image::GrayImage::from_fn(SIZE.0, SIZE.1, |x, _| [weight(x)].into()).save(path).unwrap();
}

/// A name, a change of a good dataset, and words of the message.
type Edit = (&'static str, fn(&Made), &'static str);

fn edits_are_refused(make: impl Fn() -> Made, edits: &[Edit]) {
    for (case, edit, words) in edits {
        let made = make();
        edit(&made);
        refused(case, &made, &LoadOptions::default(), words);
    }
}

/// Loads a broken dataset; the message or the remedy must contain all of `words`, which are separated by commas.
fn refused(case: &str, made: &Made, options: &LoadOptions, words: &str) {
    let Err(error) = Dataset::load(made.path(), options) else { panic!("{case}: it loaded") };
    let message = format!("{error}: {error:?}");
    for word in words.split(", ") {
        assert!(message.contains(word), "{case}: {word:?} is not in: {message}");
    }
}
