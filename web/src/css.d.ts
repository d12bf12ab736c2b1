// SPDX-License-Identifier: Apache-2.0
// Style sheets that esbuild bundles.
declare module "*.css";
