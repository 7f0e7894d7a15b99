//! Lengths in a frame are not believed: decoding allocates a bounded amount of memory.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::fmt::Debug;

use quad_protocol::*;

use crate::frames::{Check, each};

/// The system's allocator, which remembers the largest allocation of each thread.
struct Watched;

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

fn note(size: usize) {
    LARGEST.set(LARGEST.get().max(size));
}

// SAFETY: every call is passed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note(size);
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Watched = Watched;

struct ClaimTooMuch;

impl Check for ClaimTooMuch {
    /// Overwrites every eight bytes of the frame, among them every length, and decodes.
    fn check<M: Message + PartialEq + Debug>(&mut self, message: &M) {
        let frame = encode(message).unwrap();
        for claim in [u64::MAX, 1 << 60, 1 << 40, 1 << 32, 1 << 26, 1 << 22, 1 << 16] {
            for position in 7..=frame.len() - 8 {
                let mut frame = frame.clone();
                frame[position..position + 8].copy_from_slice(&claim.to_le_bytes());
                LARGEST.set(0);
                drop(decode::<M>(&frame));
                assert!(LARGEST.get() <= 4 << 20, "{claim} at byte {position}");
            }
        }
    }
}

#[test]
fn claimed_lengths_are_not_allocated() {
    each(&mut ClaimTooMuch);
}
