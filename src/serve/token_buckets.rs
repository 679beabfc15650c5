//! How often a client may ask: buckets that fill at a steady rate.

use std::collections::HashMap;
use std::hash::Hash;
use std::time::Instant;

/// Clients that are remembered.
const MOST_CLIENTS: usize = 4096;

/// A bucket for each client.
#[derive(Debug)]
pub struct Rates<K> {
    a_second: f64,
    burst: f64,
    /// What is left in each, and since when.
    buckets: HashMap<K, (f64, Instant)>,
}

impl<K: Copy + Eq + Hash> Rates<K> {
    /// Full buckets of `burst`, which fill by so much `a_second`.
    pub fn new(a_second: f64, burst: f64) -> Self {
        Self { a_second, burst, buckets: HashMap::new() }
    }

    /// Takes one from the bucket of a client, if there is one in it.
    pub fn admit(&mut self, client: K, now: Instant) -> bool {
        let (a_second, burst) = (self.a_second, self.burst);
        let filled = |(left, since): (f64, Instant)| {
            let more = now.saturating_duration_since(since).as_secs_f64() * a_second;
            (left + more).min(burst)
        };
        if self.buckets.len() >= MOST_CLIENTS && !self.buckets.contains_key(&client) {
            // A full bucket is as good as none.
            self.buckets.retain(|_, bucket| filled(*bucket) < burst);
            if self.buckets.len() >= MOST_CLIENTS {
                return false;
            }
        }
        let bucket = self.buckets.entry(client).or_insert((burst, now));
        let left = filled(*bucket);
        let admitted = left >= 1.0;
        *bucket = (if admitted { left - 1.0 } else { left }, now);
        admitted
    }

    /// Puts back what was taken.
    pub fn give_back(&mut self, client: K) {
        if let Some((left, _)) = self.buckets.get_mut(&client) {
            *left = (*left + 1.0).min(self.burst);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_client_has_its_burst_and_then_its_rate_and_others_are_not_held_up() {
        let (mut rates, now) = (Rates::new(1.0, 3.0), Instant::now());
        assert_eq!((0..5).filter(|_| rates.admit('a', now)).count(), 3);
        assert!(rates.admit('b', now));
        let later = now + Duration::from_millis(1100);
        assert!(rates.admit('a', later) && !rates.admit('a', later));
        rates.give_back('a');
        assert!(rates.admit('a', later));
    }

    #[test]
    fn clients_without_end_take_no_memory_without_end() {
        let (mut rates, now) = (Rates::new(50.0, 200.0), Instant::now());
        for n in 0..3 * MOST_CLIENTS {
            rates.admit(n, now);
        }
        assert_eq!(rates.buckets.len(), MOST_CLIENTS);
        assert!(rates.admit(usize::MAX, now + Duration::from_secs(60)));
    }
}
