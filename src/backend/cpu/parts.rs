//! Cuts a buffer for the tasks of a region. Nothing is done for a part until its task runs, and a buffer of
//! nothing has nothing for each task.
//!
//! It is one type whatever the buffer has: were it one of two iterators, a region over ten buffers would be
//! compiled for each of their thousand combinations.

use rayon::iter::plumbing::{Consumer, Producer, ProducerCallback, UnindexedConsumer, bridge};
use rayon::prelude::*;

/// The parts of a buffer, all of one length but the last.
#[derive(Debug)]
pub(super) struct Parts<'a, T> {
    buffer: &'a mut [T],
    per_task: usize,
    tasks: usize,
}

/// Cuts a buffer for so many tasks.
pub(super) fn parts<T: Send>(buffer: &mut [T], per_task: usize, tasks: usize) -> Parts<'_, T> {
    assert!(buffer.len() <= per_task * tasks, "{} over {per_task} · {tasks}", buffer.len());
    Parts { buffer, per_task, tasks }
}

impl<'a, T> Parts<'a, T> {
    /// Takes the first so many parts off.
    fn take_first(&mut self, tasks: usize) -> &'a mut [T] {
        let buffer = std::mem::take(&mut self.buffer);
        let (first, rest) = buffer.split_at_mut(buffer.len().min(tasks * self.per_task));
        self.buffer = rest;
        self.tasks -= tasks;
        first
    }
}

impl<'a, T> Iterator for Parts<'a, T> {
    type Item = &'a mut [T];

    fn next(&mut self) -> Option<Self::Item> {
        (self.tasks > 0).then(|| self.take_first(1))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (self.tasks, Some(self.tasks))
    }
}

impl<T> ExactSizeIterator for Parts<'_, T> {}

impl<T> DoubleEndedIterator for Parts<'_, T> {
    fn next_back(&mut self) -> Option<Self::Item> {
        let before = self.tasks.checked_sub(1)?;
        let buffer = std::mem::take(&mut self.buffer);
        let (rest, last) = buffer.split_at_mut(buffer.len().min(before * self.per_task));
        (self.buffer, self.tasks) = (rest, before);
        Some(last)
    }
}

/// What rayon cuts in two.
struct Cut<'a, T>(Parts<'a, T>);

impl<'a, T: Send> Producer for Cut<'a, T> {
    type Item = &'a mut [T];
    type IntoIter = Parts<'a, T>;

    fn into_iter(self) -> Parts<'a, T> {
        self.0
    }

    fn split_at(self, tasks: usize) -> (Self, Self) {
        let Self(mut rest) = self;
        let buffer = rest.take_first(tasks);
        (Self(Parts { buffer, per_task: rest.per_task, tasks }), Self(rest))
    }
}

/// [`Parts`] for a region.
#[derive(Debug)]
pub(super) struct ParParts<'a, T>(Parts<'a, T>);

impl<'a, T: Send> Parts<'a, T> {
    /// One part for each task.
    pub(super) fn par(self) -> ParParts<'a, T> {
        ParParts(self)
    }
}

impl<'a, T: Send> ParallelIterator for ParParts<'a, T> {
    type Item = &'a mut [T];

    fn drive_unindexed<C: UnindexedConsumer<Self::Item>>(self, consumer: C) -> C::Result {
        bridge(self, consumer)
    }

    fn opt_len(&self) -> Option<usize> {
        Some(self.0.tasks)
    }
}

impl<T: Send> IndexedParallelIterator for ParParts<'_, T> {
    fn drive<C: Consumer<Self::Item>>(self, consumer: C) -> C::Result {
        bridge(self, consumer)
    }

    fn len(&self) -> usize {
        self.0.tasks
    }

    fn with_producer<B: ProducerCallback<Self::Item>>(self, callback: B) -> B::Output {
        callback.callback(Cut(self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_chunks_from_both_ends_and_in_parallel() {
        for length in [1, 6, 7, 63, 64] {
            let mut numbers: Vec<usize> = (0..length).collect();
            let mut copy = numbers.clone();
            let tasks = length.div_ceil(7);
            let chunks: Vec<&mut [usize]> = copy.chunks_mut(7).collect();
            assert!(parts(&mut numbers, 7, tasks).eq(chunks));
            let chunks: Vec<&mut [usize]> = copy.chunks_mut(7).rev().collect();
            assert!(parts(&mut numbers, 7, tasks).rev().eq(chunks));
            let found = parts(&mut numbers, 7, tasks).par().map(|part| part.iter().sum());
            let found: Vec<usize> = found.collect();
            let expected: Vec<usize> = copy.chunks(7).map(|part| part.iter().sum()).collect();
            assert_eq!(found, expected);
        }
        let nothing: &mut [u8] = &mut [];
        let lengths: Vec<usize> = parts(nothing, 0, 5).par().map(|part| part.len()).collect();
        assert_eq!(lengths, [0; 5]);
    }
}
