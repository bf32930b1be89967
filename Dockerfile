# An image for NVIDIA cards; docs/install.md says how to build and run it.
FROM python:3.12-slim
# Emoji as targets need a font. CUDA's libraries come with torch, the driver with the host.
RUN apt-get update && apt-get install -y --no-install-recommends fonts-noto-color-emoji \
    && rm -rf /var/lib/apt/lists/*
COPY . /source
RUN pip install --no-cache-dir "/source[all]" -c /source/constraints.txt && rm -rf /source
ENV WARP_CACHE_PATH=/cache NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
VOLUME /cache
WORKDIR /work
ENTRYPOINT ["npa-envs"]
