use proptest::prelude::*;

use super::format::UTF8;
use super::*;

/// All variables of a file that is in memory.
fn read(bytes: &[u8]) -> Result<Vec<Array>, MatError> {
    let order = header(bytes)?;
    let mut rest = &bytes[HEADER..];
    let mut arrays = Vec::new();
    while let Some((head, after)) = rest.split_first_chunk::<TAG>() {
        let (kind, length) = tag(order, *head)?;
        let body = after.get(..length).ok_or(MatError::CutShort)?;
        arrays.push(array(order, kind, body)?);
        rest = &after[length..];
    }
    if rest.is_empty() { Ok(arrays) } else { Err(MatError::CutShort) }
}

/// Files as SciPy and MATLAB would write them, in a given byte order.
struct Writer(ByteOrder);

impl Writer {
    fn number(&self, x: u32) -> [u8; 4] {
        if self.0 == ByteOrder::Big { x.to_be_bytes() } else { x.to_le_bytes() }
    }

    fn element(&self, kind: u32, data: &[u8]) -> Vec<u8> {
        let mut out = [self.number(kind), self.number(data.len() as u32)].concat();
        out.extend(data);
        if kind != COMPRESSED {
            out.resize(out.len().next_multiple_of(8), 0);
        }
        out
    }

    fn small(&self, kind: u32, data: &[u8]) -> Vec<u8> {
        let mut out = self.number((data.len() as u32) << 16 | kind).to_vec();
        out.extend(data);
        out.resize(8, 0);
        out
    }

    fn array(&self, class: u32, dims: &[u32], name: &str, contents: &[u8]) -> Vec<u8> {
        let flags = [self.number(class), self.number(0)].concat();
        let dims: Vec<u8> = dims.iter().flat_map(|&d| self.number(d)).collect();
        let mut body = self.element(6, &flags);
        body.extend(self.element(5, &dims));
        body.extend(if name.len() <= 4 {
            self.small(1, name.as_bytes())
        } else {
            self.element(1, name.as_bytes())
        });
        body.extend(contents);
        self.element(MATRIX, &body)
    }

    fn doubles(&self, dims: &[u32], name: &str, values: &[f64]) -> Vec<u8> {
        let bytes =
            |x: &f64| if self.0 == ByteOrder::Big { x.to_be_bytes() } else { x.to_le_bytes() };
        let data: Vec<u8> = values.iter().flat_map(bytes).collect();
        self.array(6, dims, name, &self.element(9, &data))
    }

    fn compressed(&self, element: &[u8]) -> Vec<u8> {
        use std::io::Write;
        let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(element).unwrap();
        self.element(COMPRESSED, &encoder.finish().unwrap())
    }

    fn file(&self, elements: &[Vec<u8>]) -> Vec<u8> {
        let mut out = b"MATLAB 5.0 MAT-file, written by a test".to_vec();
        out.resize(124, b' ');
        let marks: [u8; 4] = if self.0 == ByteOrder::Big { *b"\x01\0MI" } else { *b"\0\x01IM" };
        out.extend(marks);
        out.extend(elements.concat());
        out
    }
}

fn sample(order: ByteOrder) -> Vec<u8> {
    let w = Writer(order);
    let text = w.array(4, &[2, 3], "", &w.element(UTF8, b"axb  y"));
    let empty = w.element(MATRIX, &[]);
    let cells = w.array(1, &[1, 2], "names", &[text, empty].concat());
    let bytes = w.array(9, &[1, 3], "rgb", &w.small(2, &[1, 2, 255]));
    let doubles = w.doubles(&[2, 2], "force", &[1.0, 2.0, -3.5, 4.0]);
    w.file(&[w.compressed(&doubles), cells, bytes, w.array(2, &[1, 1], "s", &[])])
}

#[test]
fn numbers_text_and_cells_are_read_in_either_byte_order() {
    for order in [ByteOrder::Little, ByteOrder::Big] {
        let arrays = read(&sample(order)).unwrap();
        assert_eq!(arrays[0].variable.name, "force");
        assert_eq!(arrays[0].variable.dims, [2, 2]);
        assert_eq!(arrays[0].values, ArrayValues::Numbers(vec![1.0, 2.0, -3.5, 4.0]));
        assert_eq!(arrays[1].texts(), ["ab", "x y"]);
        assert_eq!(arrays[2].variable.class, Class::Numbers { byte: true });
        assert_eq!(arrays[2].values, ArrayValues::Numbers(vec![1.0, 2.0, 255.0]));
        assert_eq!(arrays[3].variable.class, Class::Other("a structure"));
    }
}

#[test]
fn the_first_bytes_of_an_element_give_its_name_and_shape() {
    let w = Writer(ByteOrder::Little);
    let values: Vec<f64> = (0..2000).map(|i| f64::from(i).sin()).collect();
    let plain = w.doubles(&[1000, 2], "forceDrag_time", &values);
    for element in [plain.clone(), w.compressed(&plain)] {
        let (kind, _) = tag(ByteOrder::Little, *element.first_chunk().unwrap()).unwrap();
        let variable = peek(ByteOrder::Little, kind, &element[TAG..TAG + PREFIX]).unwrap();
        assert_eq!(
            (variable.name.as_str(), &variable.dims[..]),
            ("forceDrag_time", &[1000, 2][..])
        );
    }
}

#[test]
fn what_is_no_level_5_file_is_refused_with_the_remedy() {
    let mut file = sample(ByteOrder::Little);
    file[124..126].copy_from_slice(&[0, 2]);
    for bytes in [&file[..], b"\x89HDF\r\n\x1a\n", b"MATLAB 7.3 MAT-file"] {
        assert!(read(bytes).unwrap_err().to_string().contains("'-v7')"));
    }
    assert_eq!(read(b""), Err(MatError::NotMatlab));
    assert_eq!(read(&[7; 300]), Err(MatError::NotMatlab));
    let whole = sample(ByteOrder::Little);
    assert_eq!(read(&whole[..whole.len() - 9]), Err(MatError::CutShort));
}

#[test]
fn a_claim_of_more_than_the_limit_is_refused_before_memory_is_taken() {
    let w = Writer(ByteOrder::Little);
    let huge = w.array(1, &[1 << 20, 1 << 20], "huge", &[]);
    assert_eq!(read(&w.file(&[huge])), Err(MatError::TooLarge));
    let mut file = w.file(&[]);
    file.extend([w.number(MATRIX), w.number(u32::MAX)].concat());
    assert_eq!(read(&file), Err(MatError::TooLarge));
}

#[test]
fn a_few_bytes_that_stand_for_millions_of_cells_are_refused_before_memory_is_taken() {
    let w = Writer(ByteOrder::Little);
    let count = MAX_CELLS as u32 + 1;
    let empty = w.element(MATRIX, &[]);
    let list = w.array(1, &[count, 1], "list", &empty.repeat(count as usize));
    let file = w.file(&[w.compressed(&list)]);
    assert!(file.len() < 8192, "{} bytes", file.len());
    assert_eq!(read(&file), Err(MatError::TooLarge));
    // The limit is one for all cells, however deep.
    let inner = w.array(1, &[1000, 1], "", &empty.repeat(1000));
    let nested = w.array(1, &[66, 1], "list", &inner.repeat(66));
    assert_eq!(read(&w.file(&[w.compressed(&nested)])), Err(MatError::TooLarge));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]
    #[test]
    fn damaged_bytes_never_panic(
        big in any::<bool>(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..12),
        cut in any::<prop::sample::Index>(),
        whole in any::<bool>(),
    ) {
        let order = if big { ByteOrder::Big } else { ByteOrder::Little };
        let mut bytes = sample(order);
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if !whole {
            let end = cut.index(bytes.len());
            bytes.truncate(end);
        }
        let _ = read(&bytes);
        let body = bytes.get(HEADER + TAG..).unwrap_or_default();
        let _ = peek(order, ElementKind::Plain, body);
        let _ = peek(order, ElementKind::Compressed, body);
    }

    #[test]
    fn any_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        let _ = peek(ByteOrder::Little, ElementKind::Plain, &bytes);
        let _ = array(ByteOrder::Big, ElementKind::Plain, &bytes);
        let _ = array(ByteOrder::Little, ElementKind::Compressed, &bytes);
    }
}
