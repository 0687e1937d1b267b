# fprf on a CPU:   docker build -t fprf .             docker run --rm -v "$PWD:/work" fprf demo
# with CUDA:       docker build -t fprf:cuda --target cuda .   docker run --rm --gpus all -v "$PWD:/work" fprf:cuda train --data DIR
# The browser:     docker run --rm -p 127.0.0.1:8080:8080 -v "$PWD:/work" fprf view RUN --host 0.0.0.0
# Versions are those of constraints.txt. The image of CUDA has its compiler, with which gsplat is built before the first training.
FROM nvidia/cuda:12.6.3-devel-ubuntu24.04 AS cuda
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv python3-dev \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m venv /opt/fprf
ENV PATH=/opt/fprf/bin:$PATH
# The version that the package says: there is no history in the image.
ARG VERSION=0.1.dev0
ENV SETUPTOOLS_SCM_PRETEND_VERSION_FOR_FPRF=$VERSION
COPY . /src
RUN pip install --no-cache-dir -c /src/constraints.txt --extra-index-url https://download.pytorch.org/whl/cu126 \
        "/src[video,raw,splats,cuda]" \
    && useradd --create-home someone
USER someone
WORKDIR /work
ENTRYPOINT ["fprf"]

FROM python:3.13-slim AS cpu
ARG VERSION=0.1.dev0
ENV SETUPTOOLS_SCM_PRETEND_VERSION_FOR_FPRF=$VERSION
COPY . /src
RUN pip install --no-cache-dir -c /src/constraints.txt --extra-index-url https://download.pytorch.org/whl/cpu \
        "/src[video,raw,splats]" \
    && useradd --create-home someone
USER someone
WORKDIR /work
ENTRYPOINT ["fprf"]
