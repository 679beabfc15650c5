use super::*;

/// 90 vectors of three classes in turn.
fn data() -> (Array2<f32>, Vec<usize>) {
    let class: Vec<usize> = (0..90).map(|i| i % 3).collect();
    let vectors = Array2::from_shape_fn((90, 8), |(i, j)| {
        let noise = ((i * 37 + j * 101) as f32 * 0.7).sin() * (1.0 + j as f32 * 0.3);
        noise + if j == i % 3 { 2.0 } else { 0.0 }
    });
    (vectors, class)
}

/// Every third vector of a class is of an excerpt.
fn rows(class: &[usize], groups: Vec<usize>, classes: usize) -> Rows {
    Rows {
        part: (0..class.len()).map(|i| class[i] + classes * usize::from(i / 3 % 3 == 2)).collect(),
        group_count: groups.iter().max().map_or(0, |last| last + 1),
        groups,
        trials: (0..class.len()).collect(),
        classes,
    }
}

fn trained(vectors: &Array2<f32>, class: &[usize], classes: usize) -> Option<Discriminant> {
    Discriminant::train(vectors.clone(), &rows(class, vec![0; class.len()], classes), 0).0
}

/// Mahalanobis distances of a vector to the class means, by the definition, with the scatter of the
/// `kept` rows and the shrinkage of all.
fn by_definition(
    (vectors, rows): (&Array2<f32>, &Rows),
    kept: &[usize],
    vector: ArrayView1<'_, f32>,
) -> Vec<f64> {
    let z = vectors.mapv(f64::from);
    let (_, rest) = residuals(vectors.clone(), &rows.part, &rows.counts(0..rows.part.len()));
    let gamma = shrinkage(&rest, &lower_gram(&rest.view()), &rows.trials);
    let mut means = Array2::<f64>::zeros((2 * rows.classes, z.ncols()));
    let (mut freedom, mut w) = (0.0, Array2::<f64>::zeros((z.ncols(), z.ncols())));
    for (part, mut mean) in means.rows_mut().into_iter().enumerate() {
        let members: Vec<usize> = kept.iter().copied().filter(|&i| rows.part[i] == part).collect();
        mean.assign(&z.select(Axis(0), &members).mean_axis(Axis(0)).unwrap());
        for &i in &members {
            let r = (&z.row(i) - &mean).insert_axis(Axis(1));
            w += &r.dot(&r.t());
        }
        freedom += members.len() as f64 - 1.0;
    }
    let ridge = gamma * w.diag().sum() / freedom / z.ncols() as f64;
    let metric = w * ((1.0 - gamma) / freedom) + Array2::<f64>::eye(z.ncols()) * ridge;
    let factor = cholesky(metric).unwrap();
    let distance = |mean: ArrayView1<'_, f64>| {
        let mut d = (&vector.mapv(f64::from) - &mean).insert_axis(Axis(1));
        solve_lower(&factor.view(), d.view_mut());
        d.iter().map(|x| x * x).sum::<f64>()
    };
    means.rows().into_iter().take(rows.classes).map(distance).collect()
}

fn distances(of: &Discriminant, vector: ArrayView1<'_, f32>) -> Vec<f64> {
    of.distances(vector.insert_axis(Axis(0))).remove(0)
}

fn differ_alike(ours: &[f64], full: &[f64]) {
    for (a, b) in [(0, 1), (1, 2)] {
        let (ours, full) = (ours[a] - ours[b], full[a] - full[b]);
        assert!((ours - full).abs() < 1e-3 * (1.0 + full.abs()), "{ours} vs {full}");
    }
}

#[test]
fn differences_of_distances_are_those_of_the_full_mahalanobis_distance() {
    let (vectors, class) = data();
    let all: Vec<usize> = (0..90).collect();
    let ours = distances(&trained(&vectors, &class, 3).unwrap(), vectors.row(5));
    let full = by_definition((&vectors, &rows(&class, vec![], 3)), &all, vectors.row(5));
    differ_alike(&ours, &full);
    assert!(ours[0] <= full[0] + 1e-3, "a projection shortens");
}

#[test]
fn leaving_a_group_out_is_training_without_it() {
    let (vectors, class) = data();
    let groups: Vec<usize> = (0..90).map(|i| (i / 9).min(4)).collect();
    let of = rows(&class, groups.clone(), 3);
    let (all, without) = Discriminant::train(vectors.clone(), &of, of.group_count);
    assert!(all.is_some() && without.len() == 5);
    for (group, without) in without.into_iter().enumerate() {
        let kept: Vec<usize> = (0..90).filter(|&i| groups[i] != group).collect();
        for query in [3, 40, 80] {
            let ours = distances(without.as_ref().unwrap(), vectors.row(query));
            let full = by_definition((&vectors, &of), &kept, vectors.row(query));
            differ_alike(&ours, &full);
        }
    }
}

#[test]
fn a_class_of_few_trials_is_found_as_often_as_one_of_many() {
    let mut rng = crate::seed::rng(1, &[b"few"]);
    let mut drawn = |class: usize| -> Vec<f32> {
        let value = |j: usize| if j < 20 { 0.7 * class as f32 } else { 0.0 };
        (0..60).map(|j| value(j) + crate::seed::nearly_normal(&mut rng)).collect()
    };
    let class: Vec<usize> = (0..66).map(|i| usize::from(i >= 6)).collect();
    let vectors: Vec<f32> = class.iter().flat_map(|&class| drawn(class)).collect();
    let vectors = Array2::from_shape_vec((66, 60), vectors).unwrap();
    let parts = Rows { part: class, ..rows(&[0; 66], vec![0; 66], 2) };
    let trained = Discriminant::train(vectors, &parts, 0).0.unwrap();
    let mut found = |class: usize| {
        let is_found = |_: &usize| {
            let query = drawn(class);
            let of = distances(&trained, ArrayView1::from(&query));
            of[class] < of[1 - class]
        };
        (0..200).filter(is_found).count()
    };
    let found = [found(0), found(1)];
    assert!(found.iter().all(|found| *found > 120), "{found:?} of 200");
}

#[test]
fn a_class_that_is_only_in_one_group_is_unknown_without_it() {
    let (vectors, class) = data();
    let groups = class.iter().map(|&class| usize::from(class == 2)).collect();
    let (_, without) = Discriminant::train(vectors.clone(), &rows(&class, groups, 3), 2);
    let left = without[1].as_ref().unwrap();
    assert!(left.knows(0) && left.knows(1) && !left.knows(2));
    assert_eq!(distances(left, vectors.row(2))[2], f64::INFINITY);
    assert!(without[0].is_none(), "one class is nothing to choose between");
}

#[test]
fn inner_products_with_the_class_means_make_the_distance() {
    let (vectors, class) = data();
    let trained = trained(&vectors, &class, 3).unwrap();
    let z = vectors.row(4);
    let (weights, offsets) = trained.weights();
    let u = trained.projection.matrix().dot(&z).mapv(f64::from) - &trained.origin;
    let u = u.dot(&u);
    for (class, distance) in distances(&trained, z).iter().enumerate() {
        let inner = f64::from(weights.row(class).dot(&z)) - offsets[class];
        let mean = f64::from(trained.means.row(class).pow2().sum());
        assert!((distance - (u + mean - 2.0 * inner)).abs() < 1e-2);
    }
}

#[test]
fn a_detector_that_never_errs_is_trusted_within_bounds_and_a_constant_is_not() {
    let class = [0, 1, 0, 1, 0, 1];
    let switch = Array2::from_shape_fn((6, 3), |(i, j)| ((i % 2) + j) as f32);
    let trained_on = trained(&switch, &class, 2).unwrap();
    let d = distances(&trained_on, ArrayView1::from(&[1.0, 2.0, 3.0]));
    assert!(d[1] < 1e-3 && d[0].is_finite() && d[0] > 1.0, "{d:?}");
    assert!(trained(&Array2::from_elem((6, 3), 0.7), &class, 2).is_none());
    let two = switch.slice(s![..2, ..]).to_owned();
    assert!(trained(&two, &class[..2], 2).is_none());
}
