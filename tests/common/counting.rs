//! An allocator that counts, for a test binary that is alone with it.

#![allow(dead_code)] // Not every test uses all of it.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

/// Counts what is allocated, by any thread.
pub struct Counting;

/// Bytes that were ever allocated.
pub static ALLOCATED: AtomicU64 = AtomicU64::new(0);
/// Bytes that are held now.
pub static HELD: AtomicI64 = AtomicI64::new(0);
/// Most bytes that were held at a time.
pub static PEAK: AtomicI64 = AtomicI64::new(0);

// SAFETY: all is passed on to the system's allocator; the rest only counts.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let size = layout.size() as i64;
        ALLOCATED.fetch_add(layout.size() as u64, Ordering::Relaxed);
        PEAK.fetch_max(HELD.fetch_add(size, Ordering::Relaxed) + size, Ordering::Relaxed);
        // SAFETY: as of the caller.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size() as i64, Ordering::Relaxed);
        // SAFETY: as of the caller.
        unsafe { System.dealloc(at, layout) }
    }
}
