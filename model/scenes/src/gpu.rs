//! Thin-lens images on a graphics processor: `view.wgsl` draws the views, `thin_lens.wgsl` adds them.
//!
//! The scene is composed and baked on the processor; its surfaces, texels and triangles are sent over once. The rays
//! are those of the CPU, so the images agree to rounding, not only on average; texels are sent as half floats, which is
//! what shards keep of the images.

use bytemuck::{Pod, Zeroable};
use half::f16;
use holod_calibration::Resolution;
use holod_model::gpu::{Gpu, GpuError};
use wgpu::BufferUsages;

use super::points::ViewPoint;
use super::surface::{Mesh, Shape, Surface};
use super::thin_lens::{Adder, Lens};

/// Invocations of a workgroup along x and y, as the shaders have it.
const WORKGROUP: [u32; 2] = [16, 8];
/// Views that exist at once, if they fit.
const VIEWS_AT_ONCE: usize = 8;
/// Triangles of a leaf of the hierarchy, at most.
const LEAF: usize = 4;

/// The two shaders, ready to run.
pub(super) struct GpuTracer {
    gpu: Gpu,
    draw: wgpu::ComputePipeline,
    add: wgpu::ComputePipeline,
}

impl GpuTracer {
    /// Compiles the shaders.
    ///
    /// # Errors
    /// The driver refuses them.
    pub(super) fn new(gpu: Gpu) -> Result<Self, GpuError> {
        let draw = gpu.pipeline("view", include_str!("view.wgsl"))?;
        let add = gpu.pipeline("thin lens", include_str!("thin_lens.wgsl"))?;
        Ok(Self { gpu, draw, add })
    }

    pub(super) fn name(&self) -> &str {
        self.gpu.name()
    }
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Frame {
    left: f32,
    top: f32,
    grid_depth: f32,
    columns: u32,
    rows: u32,
    first_point: u32,
    surfaces: u32,
    nodes: u32,
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Batch {
    width: u32,
    height: u32,
    columns: u32,
    rows: u32,
    views: u32,
    first_point: u32,
    weight: f32,
    planes: u32,
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct PackedSurface {
    kind: u32,
    columns: i32,
    rows: i32,
    first_texel: u32,
    left: f32,
    top: f32,
    cx: f32,
    cy: f32,
    depth: f32,
    gx_rx: f32,
    gy_ry: f32,
    rd: f32,
}

impl PackedSurface {
    fn new(surface: &Surface, first_texel: u32) -> Self {
        let (kind, [cx, cy, depth, gx_rx, gy_ry, rd]) = match surface.shape {
            Shape::Plane { cx, cy, depth, gx, gy } => (0, [cx, cy, depth, gx, gy, 0.0]),
            Shape::Ellipsoid { cx, cy, depth, rx, ry, rd } => (1, [cx, cy, depth, rx, ry, rd]),
            Shape::Mesh(_) => (2, [0.0; 6]),
        };
        let (columns, rows) = (surface.columns, surface.rows);
        let (left, top) = (surface.bounds.left, surface.bounds.top);
        Self { kind, columns, rows, first_texel, left, top, cx, cy, depth, gx_rx, gy_ry, rd }
    }
}

/// x, y, depth, u and v of three corners, and the surface's number.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Triangle {
    corners: [[f32; 5]; 3],
    surface: u32,
}

impl Triangle {
    fn of(mesh: &Mesh, surface: u32) -> impl Iterator<Item = Self> {
        mesh.triangles.iter().map(move |corners| Self {
            corners: corners.map(|corner| {
                let v = mesh.vertices[corner as usize];
                [v.x, v.y, v.depth, v.u, v.v]
            }),
            surface,
        })
    }

    fn middle(&self, axis: usize) -> f32 {
        self.corners.iter().map(|corner| corner[axis]).sum()
    }
}

/// A box of the hierarchy: low and high x, y and depth.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Node {
    bounds: [[f32; 2]; 3],
    /// The first of its triangles, or of its two nodes if it has none.
    first: u32,
    triangles: u32,
}

/// Boxes around triangles, halved by number until few are left; sorts the triangles. Empty where there are none.
fn hierarchy(triangles: &mut [Triangle]) -> Vec<Node> {
    let around = |triangles: &[Triangle], first: usize| {
        let mut bounds = [[f32::INFINITY, f32::NEG_INFINITY]; 3];
        for corner in triangles.iter().flat_map(|triangle| triangle.corners) {
            for ([low, high], at) in bounds.iter_mut().zip(corner) {
                (*low, *high) = (low.min(at), high.max(at));
            }
        }
        Node { bounds, first: first as u32, triangles: triangles.len() as u32 }
    };
    if triangles.is_empty() {
        return Vec::new();
    }
    let mut nodes = vec![around(triangles, 0)];
    let mut next = 0;
    while next < nodes.len() {
        let node = nodes[next];
        let (first, count) = (node.first as usize, node.triangles as usize);
        if count > LEAF {
            // A view is looked at from the front: depth divides nothing in it.
            let [width, height] = [0, 1].map(|axis: usize| node.bounds[axis][1] - node.bounds[axis][0]);
            let axis = usize::from(height > width);
            let part = &mut triangles[first..first + count];
            part.select_nth_unstable_by(count / 2, |a, b| a.middle(axis).total_cmp(&b.middle(axis)));
            let (low, high) = part.split_at(count / 2);
            let halves = [around(low, first), around(high, first + count / 2)];
            (nodes[next].first, nodes[next].triangles) = (nodes.len() as u32, 0);
            nodes.extend(halves);
        }
        next += 1;
    }
    nodes
}

/// The sums of as many planes as a buffer takes.
struct Planes {
    count: usize,
    first: wgpu::Buffer,
    sums: wgpu::Buffer,
}

/// Sums on the graphics processor, for one scene.
pub(super) struct GpuAdder<'a> {
    tracer: &'a GpuTracer,
    lens: &'a Lens<'a>,
    surfaces: wgpu::Buffer,
    texels: wgpu::Buffer,
    triangles: wgpu::Buffer,
    nodes: wgpu::Buffer,
    node_count: u32,
    planes: Vec<Planes>,
    total: Vec<f32>,
}

impl<'a> GpuAdder<'a> {
    /// Sends the scene over.
    pub(super) fn new(tracer: &'a GpuTracer, lens: &'a Lens<'a>) -> Result<Self, GpuError> {
        let gpu = &tracer.gpu;
        let mut surfaces = Vec::new();
        let mut triangles = Vec::new();
        let mut first_texel = 0;
        for (number, surface) in lens.surfaces.iter().enumerate() {
            surfaces.push(PackedSurface::new(surface, first_texel as u32));
            first_texel += surface.texels.len();
            if let Shape::Mesh(mesh) = &surface.shape {
                triangles.extend(Triangle::of(mesh, number as u32));
            }
        }
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_DST;
        let texels = gpu.buffer("the scene's textures", (first_texel.max(1) * 8) as u64, usage)?;
        let mut packed = Vec::new();
        for (surface, place) in lens.surfaces.iter().zip(&surfaces) {
            packed.clear();
            packed.extend(surface.texels.iter().map(|texel| texel.map(|value| f16::from_f32(value).to_bits())));
            gpu.queue.write_buffer(&texels, u64::from(place.first_texel) * 8, bytemuck::cast_slice(&packed));
            // Sends it off, so that no second copy of the whole scene gathers in the queue.
            gpu.queue.submit([]);
        }
        let nodes = hierarchy(&mut triangles);

        let plane_bytes = (12 * lens.resolution.pixels()) as u64;
        let planes_at_once = ((gpu.largest_buffer / plane_bytes) as usize).clamp(1, lens.planes());
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC;
        let planes = (0..lens.planes())
            .step_by(planes_at_once)
            .map(|first| {
                let count = planes_at_once.min(lens.planes() - first);
                Ok(Planes {
                    count,
                    first: gpu.upload("plane number", &[first as u32])?,
                    sums: gpu.buffer("the sums of one focus plane", count as u64 * plane_bytes, usage)?,
                })
            })
            .collect::<Result<_, GpuError>>()?;
        Ok(Self {
            tracer,
            lens,
            surfaces: gpu.upload("surfaces", &surfaces)?,
            texels,
            triangles: gpu.upload("triangles", &triangles)?,
            nodes: gpu.upload("nodes", &nodes)?,
            node_count: nodes.len() as u32,
            planes,
            total: vec![0.0; lens.planes() * 3 * lens.resolution.pixels()],
        })
    }
}

impl Adder for GpuAdder<'_> {
    type Error = GpuError;

    fn add(&mut self, points: &[ViewPoint], weight: f32, outer: f32) -> Result<u64, GpuError> {
        let GpuTracer { gpu, draw, add } = self.tracer;
        let Resolution { width, height } = self.lens.resolution;
        let margin = self.lens.margin(outer);
        let grid = self.lens.grid(margin);
        let lifts: Vec<f32> = self.lens.lifts().collect();
        let places: Vec<[f32; 4]> = points.iter().map(|point| [point.ax, point.ay, point.dx, point.dy]).collect();
        let first_samples: Vec<u32> = points
            .iter()
            .flat_map(|point| lifts.iter().map(|&lift| Lens::first_sample(point, lift, margin, grid.columns) as u32))
            .collect();
        let view_bytes = (12 * grid.columns * grid.rows) as u64;
        let views_at_once = ((gpu.largest_buffer / view_bytes) as usize).clamp(1, VIEWS_AT_ONCE.min(points.len()));
        let colours = gpu.buffer("one view", views_at_once as u64 * view_bytes, BufferUsages::STORAGE)?;
        let uniform = |size: usize| gpu.buffer("batch", size as u64, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        let (frame, batch) = (uniform(size_of::<Frame>())?, uniform(size_of::<Batch>())?);
        let points_buffer = gpu.upload("points", &places)?;
        let first_samples = gpu.upload("first samples", &first_samples)?;
        let drawing = gpu.bind(
            draw,
            &[&frame, &points_buffer, &self.surfaces, &self.texels, &self.nodes, &self.triangles, &colours],
        );
        let adding: Vec<_> = self
            .planes
            .iter()
            .map(|planes| gpu.bind(add, &[&batch, &colours, &first_samples, &planes.first, &planes.sums]))
            .collect();

        let mut before = None;
        for first_point in (0..points.len()).step_by(views_at_once) {
            let views = views_at_once.min(points.len() - first_point) as u32;
            let (columns, rows, first_point) = (grid.columns as u32, grid.rows as u32, first_point as u32);
            let frame_of_batch = Frame {
                left: grid.left,
                top: grid.top,
                grid_depth: self.lens.middle,
                columns,
                rows,
                first_point,
                surfaces: self.lens.surfaces.len() as u32,
                nodes: self.node_count,
            };
            let planes = self.lens.planes() as u32;
            let (width, height) = (width as u32, height as u32);
            let batch_of_views = Batch { width, height, columns, rows, views, first_point, weight, planes };
            gpu.queue.write_buffer(&frame, 0, bytemuck::bytes_of(&frame_of_batch));
            gpu.queue.write_buffer(&batch, 0, bytemuck::bytes_of(&batch_of_views));
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                let groups = |columns: u32, rows: u32| (columns.div_ceil(WORKGROUP[0]), rows.div_ceil(WORKGROUP[1]));
                pass.set_pipeline(draw);
                pass.set_bind_group(0, &drawing, &[]);
                let (across, down) = groups(columns, rows);
                pass.dispatch_workgroups(across, down, views);
                pass.set_pipeline(add);
                let (across, down) = groups(width, height);
                for (planes, adding) in self.planes.iter().zip(&adding) {
                    pass.set_bind_group(0, adding, &[]);
                    pass.dispatch_workgroups(across, down, planes.count as u32);
                }
            }
            // One batch is prepared while the one before it is drawn.
            let submission = gpu.queue.submit([encoder.finish()]);
            if let Some(before) = before.replace(submission) {
                gpu.wait(before)?;
            }
        }
        before.map_or(Ok(()), |last| gpu.wait(last))?;
        Ok((points.len() * grid.columns * grid.rows) as u64)
    }

    fn sums(&mut self) -> Result<&[f32], GpuError> {
        let plane = 3 * self.lens.resolution.pixels();
        let mut rest = self.total.as_mut_slice();
        for planes in &self.planes {
            let (part, others) = rest.split_at_mut(planes.count * plane);
            self.tracer.gpu.read(&planes.sums, part)?;
            rest = others;
        }
        Ok(&self.total)
    }
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use naga::{Module, TypeInner, front::wgsl};

    use super::*;

    const VIEW: &str = include_str!("view.wgsl");
    const THIN_LENS: &str = include_str!("thin_lens.wgsl");

    /// Bytes of a structure of `wgsl` as it lies in an array, and where each 4-byte member of it, or of one in it, is.
    fn layout_in_shader(wgsl: &str, name: &str) -> (usize, Vec<(String, usize)>) {
        let module = wgsl::parse_str(wgsl).unwrap();
        let (_, found) = module.types.iter().find(|(_, found)| found.name.as_deref() == Some(name)).unwrap();
        let TypeInner::Struct { span, .. } = found.inner else { panic!("{name} is no structure") };
        let mut places = Vec::new();
        add_places(&module, &found.inner, 0, &mut places);
        (span as usize, places)
    }

    fn add_places(module: &Module, inner: &TypeInner, at: u32, places: &mut Vec<(String, usize)>) {
        let TypeInner::Struct { members, .. } = inner else { panic!("only structures have members") };
        for member in members {
            let (inner, at) = (&module.types[member.ty].inner, at + member.offset);
            match inner {
                TypeInner::Scalar(scalar) if scalar.width == 4 => {
                    places.push((member.name.clone().unwrap(), at as usize));
                }
                _ => add_places(module, inner, at, places),
            }
        }
    }

    macro_rules! layout {
        ($of:ident: $($member:ident),*) => {
            (size_of::<$of>(), vec![$((stringify!($member).to_owned(), offset_of!($of, $member))),*])
        };
    }

    #[test]
    fn structures_lie_in_the_shaders_as_they_do_here() {
        let frame = layout!(Frame: left, top, grid_depth, columns, rows, first_point, surfaces, nodes);
        let batch = layout!(Batch: width, height, columns, rows, views, first_point, weight, planes);
        let surface = layout!(PackedSurface:
            kind, columns, rows, first_texel, left, top, cx, cy, depth, gx_rx, gy_ry, rd);
        assert_eq!(layout_in_shader(VIEW, "Frame"), frame);
        assert_eq!(layout_in_shader(THIN_LENS, "Batch"), batch);
        assert_eq!(layout_in_shader(VIEW, "Surface"), surface);
        assert_ne!(layout_in_shader(THIN_LENS, "Batch"), frame, "another order of the same size is another layout");
    }

    #[test]
    fn structures_of_arrays_lie_in_the_shader_as_they_do_here() {
        let row = |count: usize| (0..count).map(|index| 4 * index);
        let (bytes, places) = layout_in_shader(VIEW, "Triangle");
        assert_eq!((bytes, offset_of!(Triangle, surface)), (size_of::<Triangle>(), 60));
        let names = ["x", "y", "depth", "u", "v"].into_iter().cycle().take(15).chain(["surface"]).map(str::to_owned);
        assert_eq!(places, names.zip(row(16)).collect::<Vec<_>>());

        let (bytes, places) = layout_in_shader(VIEW, "Node");
        assert_eq!(bytes, size_of::<Node>());
        assert_eq!((offset_of!(Node, first), offset_of!(Node, triangles)), (24, 28));
        let names = ["left", "right", "top", "bottom", "far", "near", "first", "triangles"].map(str::to_owned);
        assert_eq!(places, names.into_iter().zip(row(8)).collect::<Vec<_>>());

        let points = ["ax", "ay", "dx", "dy"].map(str::to_owned);
        assert_eq!(layout_in_shader(VIEW, "ViewPoint"), (16, points.into_iter().zip(row(4)).collect()));
    }

    #[test]
    fn workgroups_have_the_size_that_the_grids_are_made_for() {
        for wgsl in [VIEW, THIN_LENS] {
            let module = wgsl::parse_str(wgsl).unwrap();
            let [x, y] = WORKGROUP;
            assert!(module.entry_points.iter().all(|entry| entry.workgroup_size == [x, y, 1]));
            assert_eq!(module.entry_points.len(), 1);
        }
    }
}
