//! What is tried, and that files are no larger than asked.

use super::*;

#[test]
fn degrees_are_tried_from_the_models_own_down() {
    assert_eq!(degrees(3, Target::Bytes(1)), [3, 1, 0]);
    assert_eq!(degrees(1, Target::Bytes(1)), [1, 0]);
    assert_eq!(degrees(0, Target::Bytes(1)), [0]);
    assert_eq!(degrees(3, Target::Rows(1)), [3]);
}
