use std::sync::Arc;

use super::*;
use crate::dataset::builtin::PREFIX;
use crate::dataset::{Dataset, LoadOptions};

#[test]
#[ignore]
fn calibrate() {
    for name in ["spheres", "thin", "chirp", "table", "layers", "room", "glossy", "cornell"] {
        let options = LoadOptions { tracks: true, ..LoadOptions::default() };
        let path = format!("{PREFIX}{name}");
        let dataset = Dataset::load(path.as_ref(), &options).unwrap();
        println!("{name} {:?}", measure(&dataset.tracks, &dataset.train).unwrap());
    }
    for name in ["cup", "office", "beercan", "fox", "chair", "room256"] {
        let options = LoadOptions { tracks: true, ..LoadOptions::default() };
        let path = format!("/work/shared/data/{name}");
        let dataset = Dataset::load(path.as_ref(), &options).unwrap();
        println!("{name} {} {:?}", dataset.tracks.len(), measure(&dataset.tracks, &dataset.train).unwrap());
    }
}
