"""Zero123's score distillation on a tiny random model of the same architecture, in the real folder layout."""

from __future__ import annotations

import json
import pickle
import shutil
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.generate4d.priors import sds as zero123
from dpcli.generate4d.priors.sds import ScoreDistillation, annealed_timestep, camera_scalars, guided_noise
from dpcli.generate4d.priors.zero123_model import Zero123Model, load_zero123, weight_file
from dpcli.ops.cameras import orbit_pose

pytest.importorskip("diffusers")
pytest.importorskip("transformers")

CPU = torch.device("cpu")
SIZE, WIDTH = 16, 12  # of an image in pixels, of an embedding
CAMERAS = [(0.4, 0.3, 0.1), (-1.2, -0.2, 0.0), (3.0, 0.0, -0.2)]
FRAMES = [2, 0, 2]
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real layout: a subfolder per network, as `save_pretrained` writes it."""
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from safetensors.torch import save_file
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    path = tmp_path_factory.mktemp("models") / "tiny-zero123"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        UNet2DConditionModel(
            sample_size=SIZE // 2,
            in_channels=8,
            out_channels=4,
            layers_per_block=1,
            block_out_channels=(8, 16),
            down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
            up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
            norm_num_groups=4,
            attention_head_dim=4,
            cross_attention_dim=WIDTH,
        ).save_pretrained(path / "unet")
        AutoencoderKL(
            down_block_types=("DownEncoderBlock2D",) * 2,
            up_block_types=("UpDecoderBlock2D",) * 2,
            block_out_channels=(4, 8),
            norm_num_groups=4,
            latent_channels=4,
            sample_size=SIZE,
        ).save_pretrained(path / "vae")
        config = CLIPVisionConfig(
            hidden_size=16,
            intermediate_size=16,
            num_hidden_layers=1,
            num_attention_heads=2,
            image_size=12,
            patch_size=4,
            projection_dim=WIDTH,
        )
        CLIPVisionModelWithProjection(config).save_pretrained(path / "image_encoder")
        projection = torch.nn.Linear(WIDTH + 4, WIDTH)
    (path / "clip_camera_projection").mkdir()
    weights = {"proj.weight": projection.weight.data, "proj.bias": projection.bias.data}
    save_file(weights, path / "clip_camera_projection" / "diffusion_pytorch_model.safetensors")
    DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear").save_pretrained(path / "scheduler")
    return path


@pytest.fixture(scope="module")
def model(folder: Path) -> Zero123Model:
    return load_zero123(str(folder), CPU)


@pytest.fixture(scope="module")
def video() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (3, SIZE, SIZE, 4), dtype=np.uint8)


@pytest.fixture
def prior(model: Zero123Model, video: np.ndarray) -> ScoreDistillation:
    return prepared(ScoreDistillation(model, image_size=SIZE), video)


def prepared(prior: ScoreDistillation, video: np.ndarray) -> ScoreDistillation:
    prior.prepare(video)
    return prior


def renders(seed: int = 0, count: int = 3, size: int = SIZE) -> torch.Tensor:
    return torch.rand(count, size, size, 3, generator=seeded(seed)).requires_grad_()


def seeded(seed: int = 7) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def gradient_of(prior: ScoreDistillation, progress: float = 0.5, seed: int = 7) -> torch.Tensor:
    images = renders()
    prior.loss(images, CAMERAS, FRAMES, progress, seeded(seed)).backward()
    return images.grad


def expected_gradient(model: Zero123Model, video: np.ndarray, timestep: int, fourth: float | None) -> torch.Tensor:
    """Equation C.11 written out, one view at a time."""
    images, noise = renders(), torch.randn(3, 4, SIZE // 2, SIZE // 2, generator=seeded())
    abar = torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0)[
        timestep
    ].item()
    total = torch.zeros_like(images)
    for view, ((azimuth, elevation, radius), frame) in enumerate(zip(CAMERAS, FRAMES, strict=True)):
        alpha = video[frame, :, :, 3:] / 255.0
        white = (video[frame, :, :, :3] / 255.0 * alpha + 1 - alpha).astype(np.float32)
        reference = torch.from_numpy(white).permute(2, 0, 1)[None]
        scalars = [-elevation, np.sin(azimuth), np.cos(azimuth), radius if fourth is None else fourth]
        with torch.no_grad():
            latent = model.vae.encode(reference * 2 - 1).latent_dist.mean
            z = model.vae.encode(images[view : view + 1].permute(0, 3, 1, 2) * 2 - 1).latent_dist.mean * 0.18215
            noisy = abar**0.5 * z + (1 - abar) ** 0.5 * noise[view : view + 1]
            token = torch.cat([clip_embedding(model, white), torch.tensor([scalars], dtype=torch.float32)], 1)
            token = model.camera_projection(token)[:, None]
            yes = model.unet(torch.cat([noisy, latent], 1), timestep, token).sample
            no = model.unet(torch.cat([noisy, latent * 0], 1), timestep, token * 0).sample
            direction = (1 - abar) * (no + 5 * (yes - no) - noise[view : view + 1])
        z = model.vae.encode(images[view : view + 1].permute(0, 3, 1, 2) * 2 - 1).latent_dist.mean * 0.18215
        total += torch.autograd.grad(z, images, direction / 3)[0]
    return total


def clip_embedding(model: Zero123Model, image: np.ndarray) -> torch.Tensor:
    """Resized by numpy: bicubic with antialiasing (a = -0.5) as Pillow's, along rows, then columns."""

    def kernel(x: np.ndarray) -> np.ndarray:
        x = np.abs(x)
        near, far = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
        return np.where(x < 1, near, np.where(x < 2, far, 0))

    scale = SIZE / 12
    centers = (np.arange(12) + 0.5) * scale - 0.5
    rows = kernel((np.arange(SIZE) - centers[:, None]) / scale)
    rows /= rows.sum(1, keepdims=True)
    small = np.einsum("ij,jkc,lk->ilc", rows, image.astype(np.float64), rows).clip(0, 1)
    pixels = (small - [0.48145466, 0.4578275, 0.40821073]) / [0.26862954, 0.26130258, 0.27577711]
    with torch.no_grad():
        return model.image_encoder(torch.from_numpy(pixels).float().permute(2, 0, 1)[None]).image_embeds


def assert_is_equation_c11(prior: ScoreDistillation, video: np.ndarray, fourth: float | None = None) -> None:
    """The checker. Relative difference measured: 1.3e-6; of the mildest broken twin: 1.6e-2."""
    expected, found = expected_gradient(prior.model, video, 500, fourth), gradient_of(prior)
    assert (found - expected).abs().max() < 2e-5 * expected.abs().max()


def test_gradient_is_equation_c11(prior: ScoreDistillation, video: np.ndarray) -> None:
    assert_is_equation_c11(prior, video)


def test_stable_zero123_gets_the_polar_angle(folder: Path, video: np.ndarray) -> None:
    model = load_zero123(str(folder), CPU, stable=True)
    prior = prepared(ScoreDistillation(model, image_size=SIZE, reference_elevation=0.3), video)
    assert_is_equation_c11(prior, video, fourth=np.deg2rad(90) - 0.3)
    with pytest.raises(AssertionError):
        assert_is_equation_c11(prior, video)


def test_checker_rejects_broken_twins(model: Zero123Model, video: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    def make() -> ScoreDistillation:
        return prepared(ScoreDistillation(model, image_size=SIZE), video)

    scaled = make()
    scaled._reference = scaled._reference * 0.18215
    black = prepared(
        ScoreDistillation(model, image_size=SIZE), np.concatenate([video[..., :3], 255 + 0 * video[..., 3:]], -1)
    )
    for broken in (scaled, black):
        with pytest.raises(AssertionError):
            assert_is_equation_c11(broken, video)
    for name, value in (("_GUIDANCE", 4), ("_T_RANGE", (0.51, 0.8))):
        with monkeypatch.context() as patch, pytest.raises(AssertionError):
            patch.setattr(zero123, name, value)
            assert_is_equation_c11(make(), video)
    for flip in ((1, -1), (-1, 1)):

        def flipped(cameras: list, reference: float | None = None, flip: tuple = flip) -> torch.Tensor:
            return camera_scalars([(flip[0] * a, flip[1] * e, r) for a, e, r in cameras], reference)

        monkeypatch.setattr(zero123, "camera_scalars", flipped)
        with pytest.raises(AssertionError):
            assert_is_equation_c11(make(), video)


def assert_zero123_scalars(function: Callable) -> None:
    """From the camera centers, as Zero123's training data define them: Blender's z up, polar angle from +z."""

    def spherical(azimuth: float, elevation: float, radius: float) -> np.ndarray:
        pose = orbit_pose(azimuth, elevation, radius)
        center = -pose[:3, :3].T @ pose[:3, 3]
        x, y, z = center[[2, 0, 1]]  # our +z, +x, +y are their +x, +y, +z
        distance = np.sqrt(x * x + y * y + z * z)
        return np.array([np.arccos(z / distance), np.arctan2(y, x), distance])

    reference, target = (0.2, 0.1, 2.0), (1.3, -0.4, 1.7)
    polar, azimuth, distance = spherical(*target) - spherical(*reference)
    scalars = function([tuple(np.subtract(target, reference))])[0].numpy()
    np.testing.assert_allclose(scalars, [polar, np.sin(azimuth), np.cos(azimuth), distance], atol=1e-6)


def test_camera_scalars() -> None:
    assert_zero123_scalars(camera_scalars)
    assert camera_scalars([(0.0, 0.5, 0.0)])[0, 0] == -0.5  # the camera moves up: a smaller polar angle
    for azimuth, elevation in ((1, -1), (-1, 1)):
        with pytest.raises(AssertionError):
            assert_zero123_scalars(
                lambda c, a=azimuth, e=elevation: camera_scalars([(a * c[0][0], e * c[0][1], c[0][2])])
            )


def test_guidance_arithmetic() -> None:
    conditional, unconditional = torch.tensor([3.0]), torch.tensor([1.0])
    assert [guided_noise(conditional, unconditional, s).item() for s in (0, 1, 5)] == [1.0, 3.0, 11.0]


def test_timestep_anneals_within_its_range() -> None:
    assert [annealed_timestep(p, (0.2, 0.8), 1000) for p in (0.0, 0.2, 0.375, 0.8, 1.0)] == [800, 800, 625, 200, 200]
    assert [annealed_timestep(p, (0.6, 0.8), 1000) for p in (0.0, 0.3, 1.0)] == [800, 700, 600]
    assert annealed_timestep(0.0, (0.0, 1.0), 1000) == 999  # the model has steps 0..999


def test_repeats_with_the_generator_and_leaves_the_global_one_alone(prior: ScoreDistillation) -> None:
    state = torch.get_rng_state()
    once, again, other = gradient_of(prior), gradient_of(prior), gradient_of(prior, seed=8)
    assert torch.equal(once, again) and not torch.allclose(once, other, rtol=0.1)
    assert torch.equal(state, torch.get_rng_state())


def test_descent_leads_to_what_the_model_expects(prior: ScoreDistillation, monkeypatch: pytest.MonkeyPatch) -> None:
    """A denoiser that knows the true latent: following the loss brings the render's latent there."""
    with torch.no_grad():
        goal = prior._latents(renders(1))

    def knowing(stacked: torch.Tensor, timestep: torch.Tensor, encoder_hidden_states: torch.Tensor) -> SimpleNamespace:
        abar = prior.model.alphas_cumprod[timestep][:, None, None, None]
        return SimpleNamespace(sample=(stacked[:, :4] - abar.sqrt() * torch.cat([goal, goal])) / (1 - abar).sqrt())

    monkeypatch.setattr(prior.model, "unet", knowing)
    images, generator = renders(0), seeded()
    optimizer, before = torch.optim.Adam([images], 0.02), (prior._latents(images) - goal).norm().item()
    for step in range(60):
        optimizer.zero_grad()
        prior.loss(images, CAMERAS, FRAMES, step / 60, generator).backward()
        optimizer.step()
    assert (prior._latents(images) - goal).norm().item() < 0.2 * before


def test_conditions_each_frame_once(model: Zero123Model, video: np.ndarray) -> None:
    seen = []
    hook = model.image_encoder.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))
    try:
        prior = prepared(ScoreDistillation(model, image_size=SIZE), np.repeat(video, 7, 0))
        assert sum(seen) == 21 and max(seen) <= 8
        gradient_of(prior)
        assert sum(seen) == 21
    finally:
        hook.remove()


def test_larger_renders_and_oblong_frames(model: Zero123Model, video: np.ndarray) -> None:
    prior = ScoreDistillation(model, image_size=SIZE)
    oblong = np.zeros((3, SIZE, SIZE, 4), np.uint8)
    oblong[:, 4:12] = video[:, 4:12]  # what padding with white must give back
    embeddings = []
    for frames in (oblong, video[:, 4:12]):
        prior.prepare(frames)
        embeddings.append(prior._embedding)
    assert torch.equal(*embeddings)
    images = renders(size=40)
    prior.loss(images, CAMERAS, FRAMES, 0.0, seeded()).backward()
    assert images.grad.shape == images.shape and images.grad.abs().sum() > 0


def test_views_that_overflow_add_nothing(prior: ScoreDistillation, monkeypatch: pytest.MonkeyPatch) -> None:
    clean, unet = gradient_of(prior), prior.model.unet

    def overflowing(rows: list[int]) -> Callable:
        def call(stacked: torch.Tensor, timestep: torch.Tensor, encoder_hidden_states: torch.Tensor) -> SimpleNamespace:
            sample = unet(stacked, timestep, encoder_hidden_states).sample.clone()
            sample[rows] = float("nan")
            return SimpleNamespace(sample=sample)

        return call

    monkeypatch.setattr(prior.model, "unet", overflowing([1]))
    found = gradient_of(prior)
    assert not found[1].any() and torch.allclose(found[[0, 2]], clean[[0, 2]], atol=1e-7)
    monkeypatch.setattr(prior.model, "unet", overflowing([0, 1, 2]))
    with pytest.raises(DpcError, match="no view's gradient is finite"):
        gradient_of(prior)


def test_rejects_wrong_arguments(model: Zero123Model, prior: ScoreDistillation) -> None:
    images = renders()
    for wrong, cameras, frames, message in (
        (images[:, :8], CAMERAS, FRAMES, "S, S, 3"),
        (images, CAMERAS[:2], FRAMES, "2 cameras"),
        (images, CAMERAS, [0, 1, 3], "given 3 frames"),
    ):
        with pytest.raises(ValueError, match=message):
            prior.loss(wrong, cameras, frames, 0.0, seeded())
    with pytest.raises(ValueError, match="given 0 frames"):
        ScoreDistillation(model).loss(images, CAMERAS, FRAMES, 0.0, seeded())


def changed(folder: Path, target: Path, change: Callable[[Path], object]) -> str:
    shutil.copytree(folder, target)
    change(target)
    return str(target)


def edited(name: str, **values: object) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        (path / name).write_text(json.dumps(json.loads((path / name).read_text()) | values))

    return change


def without_a_tensor(path: Path) -> None:
    from safetensors.torch import load_file, save_file

    file = path / "vae" / "diffusion_pytorch_model.safetensors"
    tensors = load_file(file)
    tensors.pop("encoder.conv_in.weight")
    save_file(tensors, file, {"format": "pt"})


UNET = "unet/diffusion_pytorch_model.safetensors"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: shutil.rmtree(path / "clip_camera_projection"), "lacks clip_camera_projection weights"),
        (lambda path: shutil.rmtree(path / "vae"), "lacks vae/config.json, vae weights"),
        (lambda path: (path / "scheduler" / "scheduler_config.json").unlink(), "lacks scheduler/scheduler_config.json"),
        (lambda path: (path / UNET).write_bytes((path / UNET).read_bytes()[:5000]), "can't be loaded as UNet2DCond"),
        (edited("unet/config.json", in_channels=4), "can't be loaded as UNet2DCond"),
        (edited("image_encoder/config.json", projection_dim=8), "image_encoder.*can't be loaded as CLIPVision"),
        (
            edited("scheduler/scheduler_config.json", prediction_type="v_prediction"),
            "'v_prediction', expected 'epsilon'",
        ),
        (
            lambda path: (path / "scheduler" / "scheduler_config.json").write_text("{"),
            "not a scheduler's configuration",
        ),
        (without_a_tensor, "encoder.conv_in.weight"),
    ],
)
def test_names_what_is_wrong_with_a_folder(folder: Path, tmp_path: Path, change: Callable, message: str) -> None:
    with pytest.raises(DataError, match=message):
        load_zero123(changed(folder, tmp_path / "broken", change), CPU)


def test_code_in_a_bin_file_is_not_run(folder: Path, tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> tuple:
            return Path.touch, (tmp_path / "run",)

    def change(path: Path) -> None:
        file = path / "clip_camera_projection" / "diffusion_pytorch_model.safetensors"
        file.unlink()
        file.with_suffix(".bin").write_bytes(pickle.dumps(Payload(), protocol=2))

    with pytest.raises(DataError, match="not a file of plain tensors"):
        load_zero123(changed(folder, tmp_path / "evil", change), CPU)
    assert not (tmp_path / "run").exists()


def test_another_architecture_is_told(folder: Path, tmp_path: Path) -> None:
    """A plain Stable Diffusion UNet takes 4 channels: whole and loadable, but no Zero123."""
    from diffusers import UNet2DConditionModel

    def change(path: Path) -> None:
        config = json.loads((path / "unet" / "config.json").read_text()) | {"in_channels": 4}
        UNet2DConditionModel.from_config(config).save_pretrained(path / "unet")

    with pytest.raises(DataError, match="in_channels is 4, expected 8; this is not a Zero123 model"):
        load_zero123(changed(folder, tmp_path / "sd", change), CPU)


def test_bin_weights_load_alike(folder: Path, model: Zero123Model, tmp_path: Path) -> None:
    from safetensors.torch import load_file

    def pickled(path: Path) -> None:
        for file in path.glob("*/*.safetensors"):
            name = "pytorch_model.bin" if file.name == "model.safetensors" else file.with_suffix(".bin").name
            torch.save(load_file(file), file.with_name(name))
            file.unlink()

    other = load_zero123(changed(folder, tmp_path / "stable-bin", pickled), CPU)
    assert other.stable and not model.stable
    for name in ("unet", "image_encoder", "camera_projection"):
        ours, theirs = getattr(model, name).state_dict(), getattr(other, name).state_dict()
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)


def test_half_precision(folder: Path, video: np.ndarray, prior: ScoreDistillation) -> None:
    half = load_zero123(str(folder), CPU, half=True)
    for network in (half.unet, half.vae, half.image_encoder, half.camera_projection):
        assert {p.dtype for p in network.parameters()} == {torch.float16}
        assert not any(p.requires_grad for p in network.parameters()) and not network.training
    expected, found = gradient_of(prior), gradient_of(prepared(ScoreDistillation(half, image_size=SIZE), video))
    assert found.dtype == torch.float32
    assert (found - expected).norm() < 0.02 * expected.norm()


def test_loads_as_the_command_does(
    folder: Path, video: np.ndarray, prior: ScoreDistillation, capsys: pytest.CaptureFixture
) -> None:
    loaded = prepared(ScoreDistillation.load(str(folder), "cpu", image_size=SIZE), video)
    torch.testing.assert_close(gradient_of(loaded), gradient_of(prior), rtol=1e-4, atol=1e-6)
    shown = capsys.readouterr()
    assert "a minute a step" in shown.err and not shown.out


def test_which_weights_are_taken() -> None:
    names = ["config.json", "model.fp16.safetensors", "model.safetensors", "pytorch_model.bin", "x.safetensors"]
    assert weight_file(names, half=True) == ("model.fp16.safetensors", "fp16", True)
    assert weight_file(names, half=False) == ("model.safetensors", "", True)
    assert weight_file(names[3:], half=True) == ("pytorch_model.bin", "", False)
    assert weight_file(["diffusion_pytorch_model.fp16_ema.bin"], half=False)[1] == "fp16_ema"
    assert weight_file(["config.json", "model.non_ema.safetensors"], half=False) is None


def test_a_folder_asks_no_network(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a connection was tried")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    load_zero123(str(folder), CPU)


class Hub:
    """Stands in for huggingface_hub's two calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, cached: bool, online: bool) -> None:
        import huggingface_hub

        self.folder, self.cached, self.online, self.patterns = folder, cached, online, None
        monkeypatch.setattr(huggingface_hub, "snapshot_download", self.download)
        monkeypatch.setattr(huggingface_hub.HfApi, "list_repo_files", lambda _, name: self.files(name))

    def files(self, name: str) -> list[str]:
        if not self.online:
            raise ConnectionError("Name or service not known")
        names = [path.relative_to(self.folder).as_posix() for path in self.folder.glob("*/*")]
        return [*names, "README.md", "unet/diffusion_pytorch_model.fp16.bin", "unet/zero123.py"]

    def download(self, name: str, local_files_only: bool = False, allow_patterns: list[str] | None = None) -> str:
        if local_files_only and not self.cached:
            raise FileNotFoundError(name)
        self.patterns = allow_patterns
        return str(self.folder)


def test_hub_is_asked_only_for_what_is_needed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hub = Hub(monkeypatch, folder, cached=False, online=True)
    load_zero123("someone/zero123", CPU)
    assert sorted(hub.patterns) == sorted(p.relative_to(folder).as_posix() for p in folder.glob("*/*"))
    hub = Hub(monkeypatch, folder, cached=True, online=False)
    assert load_zero123("someone/stable-zero123", CPU).stable and hub.patterns is None


def test_offline_says_how_to_get_the_weights(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Hub(monkeypatch, folder, cached=False, online=False)
    with pytest.raises(DataError, match="Name or service not known.*hf download someone/zero123 --local-dir FOLDER"):
        load_zero123("someone/zero123", CPU)
    with pytest.raises(DataError, match="no such folder, and no hub id"):
        load_zero123("./models/zero123", CPU)


def test_says_what_to_install_or_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="needs --prior-model"):
        load_zero123(None, CPU)
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(UsageError, match=r"pip install 'dpc-toolkit\[zero123\]'"):
        load_zero123(str(folder), CPU)
