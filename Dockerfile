# Image for training on NVIDIA GPUs:
#   docker build -t bounce_mjx .
#   docker run --init --gpus all -v "$PWD/runs:/app/runs" bounce_mjx --stop-when-solved
FROM python:3.12-slim

# EGL and a software OpenGL driver, to render videos.
RUN apt-get update \
 && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri \
 && rm -rf /var/lib/apt/lists/*

WORKDIR /app
COPY pyproject.toml README.md LICENSE train_jax.py ./
COPY src src
COPY configs configs
COPY mjcf mjcf
COPY pretrained pretrained
RUN pip install --no-cache-dir ".[cuda]"

ENTRYPOINT ["python", "train_jax.py"]
