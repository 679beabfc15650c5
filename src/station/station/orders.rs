//! Orders to keep scans as trials. They say which scans an order covers, and how many were kept.
//!
//! An order covers scans that begin after it was given; a scan in progress belongs to the previous
//! order. The station's own order, set before the start, covers scans that no later order covers.

use super::event::{Enrolled, EnrolledOutcome, Enrolling, RefusedScan};
use crate::trial::normal;

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keep {
    pub surface: String,
    pub user: String,
    /// The number of trials; `None` to keep every scan until the station ends.
    pub trials: Option<u32>,
    /// Whether a scan that would be a bad trial is refused.
    pub good_only: bool,
    /// Who gave the order; `None` if nobody gave a name.
    pub ordered_by: Option<String>,
}

/// The order under which a scan is kept as a trial.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Enrolment {
    pub order: u64,
    pub keep: Keep,
}

#[derive(Debug)]
struct Order {
    enrolment: Enrolment,
    kept: u32,
    /// How many of these a library could name before they were added, and how many it named right.
    asked: u32,
    right: u32,
    /// The order's last scan, if it was refused.
    refused: Option<RefusedScan>,
    being_written: u32,
    /// Number of the first scan that the order covers.
    from: u32,
    /// Number of the first scan that the order no longer covers; `None` while it is in force.
    until: Option<u32>,
}

impl Order {
    fn new(order: u64, keep: Keep, from: u32) -> Self {
        // A library has its labels in normal form, with which those of the order are compared.
        let (surface, user) = (normal(&keep.surface), normal(&keep.user));
        let enrolment = Enrolment { order, keep: Keep { surface, user, ..keep } };
        let (kept, asked, right) = (0, 0, 0);
        Self { enrolment, kept, asked, right, refused: None, being_written: 0, from, until: None }
    }

    /// Number of trials still to be kept; `None` if every scan is kept.
    fn wanted(&self) -> Option<u32> {
        self.enrolment.keep.trials.map(|trials| trials.saturating_sub(self.kept))
    }

    /// Number of scans still to come; `None` if every scan is kept.
    fn to_come(&self) -> Option<u32> {
        self.wanted().map(|wanted| wanted.saturating_sub(self.being_written))
    }

    fn keeps(&self, scan: u32) -> bool {
        let covers = self.from <= scan && self.until.is_none_or(|until| scan < until);
        covers && self.to_come() != Some(0)
    }

    /// Whether the order has all its trials, or covers no scan to come while no scan is being written.
    fn is_over(&self) -> bool {
        let covers_none = self.until.is_some_and(|until| until <= self.from);
        self.wanted() == Some(0) || covers_none && self.being_written == 0
    }
}

/// The order number of the station's own order.
const OWN: u64 = 0;

#[derive(Debug, Default)]
pub(super) struct Orders {
    /// The station's own order if it has one, then the others, the newest last. Only the newest of
    /// the others may still be in force.
    all: Vec<Order>,
    /// Number of orders given so far, which is also the order number of the newest one.
    count: u64,
}

impl Orders {
    /// Gives the station its own order, which covers all scans that no other order covers.
    pub(super) fn set_own(&mut self, keep: Keep) {
        self.all.insert(0, Order::new(OWN, keep, 0));
    }

    /// Puts an order in force from scan `next` on, in place of the previous order.
    pub(super) fn give(&mut self, keep: Keep, next: u32) {
        self.end(next);
        self.count += 1;
        self.all.push(Order::new(self.count, keep, next));
    }

    /// Ends the current order from scan `next` on, unless it is the station's own order.
    pub(super) fn end(&mut self, next: u32) {
        let given = self.all.iter_mut().filter(|order| order.enrolment.order != OWN);
        given.for_each(|order| order.until = order.until.or(Some(next)));
        self.forget();
    }

    /// The order that keeps the scan in progress, given its `number`; `None` if it is only to be named.
    pub(super) fn covering(&self, number: u32) -> Option<&Enrolment> {
        let order = self.all.iter().rev().find(|order| order.keeps(number))?;
        Some(&order.enrolment)
    }

    /// Takes the order that keeps scan `number`, which has just ended; `None` if it is only to be named.
    /// Scans end in the order of their numbers.
    pub(super) fn claim(&mut self, number: u32) -> Option<Enrolment> {
        // Scans with lower numbers have all ended, so an order no longer covers them.
        self.all.iter_mut().for_each(|order| order.from = order.from.max(number));
        let order = self.all.iter_mut().rev().find(|order| order.keeps(number));
        let enrolment = order.map(|order| {
            order.being_written += 1;
            order.enrolment.clone()
        });
        self.forget();
        enrolment
    }

    /// Counts the outcome of a scan in its order, and sets `wanted`, the trials that the order lacks.
    pub(super) fn count(&mut self, of: &Enrolment, mut enrolled: Enrolled) -> Enrolled {
        // A refused scan can be kept anyway until the next scan is judged, whatever its order.
        for order in &mut self.all {
            order.refused.take_if(|last| last.scan <= enrolled.scan);
        }
        if let Some(order) = self.all.iter_mut().find(|order| order.enrolment.order == of.order) {
            let ended = enrolled.outcome != EnrolledOutcome::Waiting;
            order.being_written = order.being_written.saturating_sub(u32::from(ended));
            order.kept += u32::from(enrolled.outcome == EnrolledOutcome::Kept);
            let is_asked = enrolled.known > Some(0);
            let is_right = enrolled.nearest.as_ref() == Some(&enrolled.surface);
            order.asked += u32::from(is_asked);
            order.right += u32::from(is_asked && is_right);
            if enrolled.outcome == EnrolledOutcome::Refused {
                let (scan, doubts) = (enrolled.scan, enrolled.doubts.clone());
                order.refused = Some(RefusedScan { scan, doubts });
            }
            enrolled.wanted = match order.until {
                None => order.wanted(),
                Some(_) => Some(0),
            };
        }
        self.forget();
        enrolled
    }

    /// Takes the order that refused `scan`, to keep that scan anyway; `None` if a later one was judged.
    pub(super) fn keep_refused(&mut self, scan: u32) -> Option<Enrolment> {
        let mut all = self.all.iter_mut();
        let order = all.find(|o| o.refused.as_ref().is_some_and(|last| last.scan == scan))?;
        order.refused = None;
        order.being_written += 1;
        Some(order.enrolment.clone())
    }

    /// The order that the next scan falls under, if any.
    pub(super) fn in_force(&self) -> Option<Enrolling> {
        let open = |order: &&Order| order.until.is_none() && order.to_come() != Some(0);
        let order = self.all.iter().rev().find(open)?;
        let Keep { surface, user, trials, ordered_by, .. } = order.enrolment.keep.clone();
        let (wanted, refused) = (order.to_come(), order.refused.clone());
        let Order { kept, asked, right, .. } = *order;
        Some(Enrolling { surface, user, wanted, trials, kept, asked, right, refused, ordered_by })
    }

    fn forget(&mut self) {
        self.all.retain(|order| !order.is_over());
    }
}

#[cfg(test)]
mod tests {
    use super::super::store::enrolled;
    use super::*;

    fn keep(surface: &str, trials: Option<u32>) -> Keep {
        let (surface, user) = (surface.into(), "anna".into());
        Keep { surface, user, trials, good_only: true, ordered_by: None }
    }

    fn became(of: &Enrolment, outcome: EnrolledOutcome) -> Enrolled {
        enrolled(1, of, outcome, Vec::new())
    }

    /// An order for trials of oak, and its enrolment of scan 1.
    fn oak(trials: u32) -> (Orders, Enrolment) {
        let mut orders = Orders::default();
        orders.give(keep("oak", Some(trials)), 1);
        let oak = orders.claim(1).unwrap();
        (orders, oak)
    }

    fn label(claimed: Option<Enrolment>) -> Option<String> {
        claimed.map(|enrolment| enrolment.keep.surface)
    }

    fn in_force(orders: &Orders) -> Option<(String, Option<u32>)> {
        orders.in_force().map(|now| (now.surface, now.wanted))
    }

    #[test]
    fn an_order_during_a_scan_counts_from_the_next_one_on() {
        let mut orders = Orders::default();
        orders.give(keep("oak", Some(5)), 1);
        // Scan 1 is in progress, so the new order begins with scan 2.
        orders.give(keep("ash", Some(5)), 2);
        assert_eq!(label(orders.claim(1)).as_deref(), Some("oak"));
        assert_eq!(label(orders.claim(2)).as_deref(), Some("ash"));
        // Scan 3 is in progress, so the order ends before scan 4.
        orders.end(4);
        assert_eq!(label(orders.claim(3)).as_deref(), Some("ash"));
        assert_eq!(label(orders.claim(4)), None);
    }

    #[test]
    fn a_label_has_its_normal_form_however_it_was_typed() {
        let mut orders = Orders::default();
        orders.give(keep("cafe\u{301}", None), 1);
        assert_eq!(label(orders.claim(1)).as_deref(), Some("caf\u{e9}"));
    }

    #[test]
    fn what_was_ordered_while_a_scan_is_written_stays_in_force() {
        let (mut orders, oak) = oak(1);
        assert_eq!(in_force(&orders), None, "nothing more is to come");
        orders.give(keep("ash", Some(2)), 2);
        let counted = orders.count(&oak, became(&oak, EnrolledOutcome::Kept));
        assert_eq!(counted.wanted, Some(0));
        assert_eq!(in_force(&orders), Some(("ash".into(), Some(2))));
        // The user gives another order with the same label.
        let ash = orders.claim(2).unwrap();
        orders.give(keep("ash", Some(2)), 3);
        orders.count(&ash, became(&ash, EnrolledOutcome::Kept));
        assert_eq!(in_force(&orders), Some(("ash".into(), Some(2))));
    }

    #[test]
    fn an_order_counts_the_trials_that_a_library_with_their_surface_named_right_before() {
        let (mut orders, oak) = oak(9);
        let mut count = |known, nearest: Option<&str>| {
            let nearest = nearest.map(String::from);
            let kept = became(&oak, EnrolledOutcome::Kept);
            orders.count(&oak, Enrolled { known, nearest, ..kept });
            let now = orders.in_force().unwrap();
            (now.kept, now.asked, now.right)
        };
        assert_eq!(count(None, None), (1, 0, 0), "no library");
        assert_eq!(count(Some(0), Some("ash")), (2, 0, 0), "it lacked the surface");
        assert_eq!(count(Some(3), Some("oak")), (3, 1, 1));
        assert_eq!(count(Some(3), Some("ash")), (4, 2, 1));
        assert_eq!(count(Some(3), None), (5, 3, 1), "unknown");
    }

    #[test]
    fn a_refused_scan_is_to_come_again_and_a_waiting_one_is_not() {
        let (mut orders, oak) = oak(1);
        assert_eq!(orders.count(&oak, became(&oak, EnrolledOutcome::Refused)).wanted, Some(1));
        assert_eq!(in_force(&orders), Some(("oak".into(), Some(1))));
        let oak = orders.claim(2).unwrap();
        assert_eq!(orders.count(&oak, became(&oak, EnrolledOutcome::Waiting)).wanted, Some(1));
        assert_eq!((in_force(&orders), label(orders.claim(3))), (None, None));
        assert_eq!(orders.count(&oak, became(&oak, EnrolledOutcome::Kept)).wanted, Some(0));
    }

    #[test]
    fn a_refused_scan_can_be_kept_anyway_until_the_next_one() {
        let (mut orders, oak) = oak(2);
        orders.count(&oak, became(&oak, EnrolledOutcome::Refused));
        assert_eq!(orders.in_force().unwrap().refused.map(|refused| refused.scan), Some(1));
        assert_eq!(orders.keep_refused(2), None, "another scan");
        assert_eq!(orders.keep_refused(1).as_ref(), Some(&oak));
        assert_eq!(orders.keep_refused(1), None, "once");
        assert_eq!(in_force(&orders), Some(("oak".into(), Some(1))));
        assert_eq!(orders.count(&oak, became(&oak, EnrolledOutcome::Kept)).wanted, Some(1));
        let now = orders.in_force().unwrap();
        assert_eq!((now.trials, now.kept, now.refused), (Some(2), 1, None));
    }

    #[test]
    fn a_refused_scan_cannot_be_kept_once_a_scan_of_another_order_was_judged() {
        let mut orders = Orders::default();
        orders.set_own(keep("felt", None));
        let felt = orders.claim(1).unwrap();
        orders.count(&felt, became(&felt, EnrolledOutcome::Refused));
        orders.give(keep("oak", Some(2)), 2);
        let oak = orders.claim(2).unwrap();
        orders.count(&oak, enrolled(2, &oak, EnrolledOutcome::Refused, Vec::new()));
        assert_eq!((orders.keep_refused(1), orders.keep_refused(2)), (None, Some(oak)));
    }

    #[test]
    fn the_stations_own_order_continues_after_each_other_one() {
        let mut orders = Orders::default();
        orders.set_own(keep("felt", None));
        assert_eq!(label(orders.claim(1)).as_deref(), Some("felt"));
        orders.give(keep("oak", Some(1)), 2);
        assert_eq!(in_force(&orders), Some(("oak".into(), Some(1))));
        assert_eq!(label(orders.claim(2)).as_deref(), Some("oak"));
        // The station's own order covers scan 3. If scan 2 is refused, "oak" stays in force.
        assert_eq!(label(orders.claim(3)).as_deref(), Some("felt"));
        orders.end(4);
        assert_eq!(label(orders.claim(4)).as_deref(), Some("felt"));
        assert_eq!(in_force(&orders), Some(("felt".into(), None)));
    }

    #[test]
    fn orders_that_cover_no_scan_are_forgotten() {
        let mut orders = Orders::default();
        (0..1000).for_each(|_| orders.give(keep("oak", Some(1)), 1));
        assert_eq!(orders.all.len(), 1);
        orders.give(keep("ash", Some(1)), 2);
        assert_eq!(orders.all.len(), 2, "scan 1 is in progress");
        assert_eq!(label(orders.claim(3)).as_deref(), Some("ash"), "scan 1 was given up");
        assert_eq!(orders.all.len(), 1);
    }
}
