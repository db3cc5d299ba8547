//! Rows that hold a number that is not finite, as on the native backend.

use densify::backend::Backend;
use densify::gaussians::Gaussians;
use densify_policies::policy::Needs;

use super::{backend_for, subjects};
use crate::quarantine::{
    Make, a_poisoned_moment_poisons_its_parameter, every_number_that_is_none_is_found,
    the_others_train_as_if_it_were_not_there,
};

fn on_every_device(test: impl Fn(Make<'_>)) {
    for device in subjects() {
        test(&|model: &Gaussians| -> Box<dyn Backend> {
            Box::new(backend_for(model, device, &Needs::default()))
        });
    }
}

#[test]
fn every_number_that_is_none_is_found_on_every_device() {
    on_every_device(every_number_that_is_none_is_found);
}

#[test]
fn the_others_train_on_every_device_as_if_it_were_not_there() {
    on_every_device(the_others_train_as_if_it_were_not_there);
}

#[test]
fn a_poisoned_moment_poisons_its_parameter_on_every_device() {
    on_every_device(a_poisoned_moment_poisons_its_parameter);
}
