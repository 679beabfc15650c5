//! A ring of bytes between an interrupt and the main loop.

use core::sync::atomic::{AtomicU8, AtomicUsize, Ordering};

/// A ring of N bytes (a power of two) with one producer and one consumer. Atomic cells make it safe
/// without a lock; on this processor, they are plain loads and stores.
pub struct ByteRing<const N: usize> {
    cells: [AtomicU8; N],
    written: AtomicUsize,
    read: AtomicUsize,
}

impl<const N: usize> Default for ByteRing<N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const N: usize> ByteRing<N> {
    /// An empty ring.
    #[must_use]
    pub const fn new() -> Self {
        const { assert!(N.is_power_of_two()) };
        Self {
            cells: [const { AtomicU8::new(0) }; N],
            written: AtomicUsize::new(0),
            read: AtomicUsize::new(0),
        }
    }

    /// Number of bytes that still fit.
    pub fn free(&self) -> usize {
        let written = self.written.load(Ordering::Acquire);
        N - written.wrapping_sub(self.read.load(Ordering::Acquire))
    }

    /// Puts in all of `bytes`, or none if they do not fit: then it returns `false`. Producer only.
    pub fn push(&self, bytes: &[u8]) -> bool {
        if self.free() < bytes.len() {
            return false;
        }
        let written = self.written.load(Ordering::Relaxed);
        for (i, &byte) in bytes.iter().enumerate() {
            self.cells[written.wrapping_add(i) % N].store(byte, Ordering::Relaxed);
        }
        self.written.store(written.wrapping_add(bytes.len()), Ordering::Release);
        true
    }

    /// Takes the oldest byte; `None` if the ring is empty. Consumer only.
    pub fn pop(&self) -> Option<u8> {
        let read = self.read.load(Ordering::Relaxed);
        if self.written.load(Ordering::Acquire) == read {
            return None;
        }
        let byte = self.cells[read % N].load(Ordering::Relaxed);
        self.read.store(read.wrapping_add(1), Ordering::Release);
        Some(byte)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_ring_refuses_the_whole_slice() {
        let ring = ByteRing::<8>::new();
        assert!(ring.push(&[1; 6]));
        assert!(!ring.push(&[2; 3]));
        assert_eq!(ring.free(), 2);
        assert!(ring.push(&[3; 2]));
        assert_eq!(ring.free(), 0);
        assert_eq!(std::iter::from_fn(|| ring.pop()).collect::<Vec<_>>(), [1, 1, 1, 1, 1, 1, 3, 3]);
    }

    #[test]
    fn bytes_cross_between_threads_in_order() {
        let ring = ByteRing::<64>::new();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for i in 0..20_000u32 {
                    while !ring.push(&i.to_le_bytes()) {
                        std::thread::yield_now();
                    }
                }
            });
            for i in 0..20_000u32 {
                for byte in i.to_le_bytes() {
                    let got = loop {
                        match ring.pop() {
                            Some(got) => break got,
                            None => std::thread::yield_now(),
                        }
                    };
                    assert_eq!(got, byte);
                }
            }
        });
    }
}
