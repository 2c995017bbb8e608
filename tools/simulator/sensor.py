"""From light to grey values: soft optics, vignetting, gain, noise, the even lines, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Sensor:
    """How the camera turns light into grey values."""

    blur_px: float = 0.9
    """Blur of the optics, standard deviation in pixels of the full frame."""
    video_blur_px: float = 0.5
    """Further blur along the lines: the bandwidth of analog video (pixels)."""
    glare: float = 0.03
    """Share of the light that the lens scatters widely."""
    vignetting: float = 0.25
    """Loss of light in the image's corners."""
    target: float = 0.42
    """Mean grey value that the automatic gain aims at, as a share of white."""
    gain_jitter: float = 0.06
    """Standard deviation of the gain's logarithm from frame to frame."""
    gamma: float = 0.8
    """Exponent from light to grey value."""
    noise_grey: float = 2.0
    """Standard deviation of the noise in the dark, grey values."""
    shot_noise_grey: float = 1.5
    """Standard deviation of the further noise at white, grey values; grows as the square root."""
    exposure: float = 0.03
    """Time of exposure as a share of the time between frames."""
    jpeg_quality: int = 80


def grey_values(
    radiance: NDArray[np.float32], sensor: Sensor, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The field image that the camera gives of a frame's light.

    Parameters
    ----------
    radiance : (2 H, W) float32
        Light on all lines, motion blur included.
    sensor : Sensor
        The camera's electronics and optics.
    rng : numpy Generator
        Source of noise and gain jitter.

    Returns
    -------
    (H, W) uint8
        The even lines.
    """
    light = _through_lens(radiance, sensor)[::2]
    rows, columns = light.shape
    bright = np.clip(light, 0.0, 1.5).mean()
    gain = (sensor.target / max(float(bright), 1e-3)) ** 0.8
    gain *= np.exp(sensor.gain_jitter * rng.standard_normal())
    x = np.linspace(-1.0, 1.0, columns)[None, :]
    y = np.linspace(-1.0, 1.0, rows)[:, None] * 0.75
    falloff = 1.0 - sensor.vignetting * (x * x + y * y) / (1.0 + 0.75**2)
    exposed = np.clip(gain * falloff * light, 0.0, None)
    grey = 255.0 * exposed**sensor.gamma
    sigma = np.sqrt(
        sensor.noise_grey**2 + sensor.shot_noise_grey**2 * np.minimum(grey, 255.0) / 255.0
    )
    noisy = np.minimum(grey, 255.0) + sigma * rng.standard_normal(grey.shape)
    # Past saturation noise no longer shows.
    noisy = np.where(grey > 262.0, 255.0, noisy)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _through_lens(radiance: NDArray[np.float32], sensor: Sensor) -> NDArray[np.float64]:
    import cv2

    light: NDArray[Any] = radiance.astype(np.float64)
    across = float(np.hypot(sensor.blur_px, sensor.video_blur_px))
    if across > 0.0:
        light = cv2.GaussianBlur(
            light, (0, 0), sigmaX=across, sigmaY=max(sensor.blur_px, 1e-3),
            borderType=cv2.BORDER_REPLICATE,
        )  # fmt: skip
    if sensor.glare > 0.0:
        small = cv2.resize(light, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
        wide = cv2.GaussianBlur(small, (0, 0), sigmaX=4.0, borderType=cv2.BORDER_REFLECT)
        scattered = cv2.resize(wide, light.shape[::-1], interpolation=cv2.INTER_LINEAR)
        light = (1.0 - sensor.glare) * light + sensor.glare * scattered
    return np.asarray(light)


def encode_jpeg(grey: NDArray[np.uint8], quality: int) -> bytes:
    """A grey JPEG file's bytes."""
    import cv2

    done, encoded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of {grey.shape} could not be encoded as JPEG")
    return bytes(encoded)
